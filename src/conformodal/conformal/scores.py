"""Nonconformity scores of bins: the lower, the better a bin fits. For a new score see :class:`Score`."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import as_choice, brief, check_number


@runtime_checkable
class Score(Protocol):
    """A nonconformity score; ``examples/custom_score.py`` is a complete example.

    ``of_bins`` takes one target's probabilities (n, K) and bin widths (K,) and returns the scores (n, K), in the
    probabilities' own floating type. A row's scores may depend on that row only.

    Two attributes are optional. ``normalised`` (bool): scores of different targets are comparable, so that one
    threshold over all of them needs no scales. ``per_unit`` (bool): scores have a unit, one over that of the target.
    """

    name: str

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """Scores of all bins."""
        ...


class Lac:
    """Least ambiguous set-valued classifier, the paper's score: one minus the bin's probability.

    Source: Sadinle, Lei and Wasserman (2019); the paper, section 2.
    """

    name = "lac"

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """``1 - proba``."""
        return np.asarray(1 - proba)


class Density:
    """Minus the probability density of the bin (probability over width).

    For bins of unequal width, level sets of the density are the shortest sets of a given probability; level sets
    of the probability are not.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import Density
    >>> proba, widths = np.array([[0.5, 0.3, 0.2]]), np.array([2.0, 1.0, 1.0])
    >>> Density().of_bins(proba, widths)  # the widest bin is no longer the first
    array([[-0.25, -0.3 , -0.2 ]])
    """

    name = "density"
    per_unit = True

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """``-proba / widths``."""
        least = 2 / float(np.finfo(proba.dtype).max)  # narrower bins have a large density, but not an infinite one
        return np.asarray(proba * -(1 / np.maximum(widths, least)).astype(proba.dtype))


class ScaledDensity(Density):
    """Minus the density, times the exponential of a multiple of its differential entropy.

    The exponential of the entropy is the length of a uniform distribution as wide as the row's. With a `power` of 0,
    one level of the density holds for all rows, as of :class:`Density`: sets are shortest on average, but rows of wide
    distributions are covered less often than others. With 1, levels fall as distributions widen, so that rows of one
    shape and any width are covered alike.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import ScaledDensity
    >>> proba, widths = np.array([[0.5, 0.5, 0, 0], [0.25, 0.25, 0.25, 0.25]]), np.ones(4)
    >>> ScaledDensity(1).of_bins(proba, widths)  # half as dense over twice the length
    array([[-0.25, -0.25, -0.  , -0.  ],
           [-0.25, -0.25, -0.25, -0.25]])
    """

    def __init__(self, power: float) -> None:
        check_number(power, "power", Range(0))
        self.power = power
        self.name = f"scaled density ({power:g})"

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """``-proba / widths * exp(power * entropy)``, the entropy relative to that of a uniform one over all bins."""
        scale = np.exp(self.power * relative_entropy(proba, widths))
        return np.asarray(super().of_bins(proba, widths) * scale[:, None].astype(proba.dtype))


def relative_entropy(proba: RealArray, widths: FloatArray) -> FloatArray:
    """Differential entropies (n,) of rows, less that of the uniform distribution over all bins: 0 or less."""
    shares = widths / widths.max()
    shares = shares / shares.sum()
    logs = np.maximum(proba, np.finfo(np.float32).tiny, dtype=np.float32)  # whose logarithms take a third of the time
    np.log(logs, out=logs)
    terms = np.multiply(proba, logs, dtype=np.float64)
    return np.asarray(proba @ np.log(shares) - terms.sum(axis=1), dtype=np.float64)


class Interval:
    """Distance from the mean in standard deviations: sets are single intervals around the mean.

    Source: normalised residuals (Papadopoulos, Gammerman and Vovk 2008), of the row's own distribution.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import Interval
    >>> Interval().of_bins(np.array([[0.5, 0, 0.5]]), np.ones(3)).round(2)
    array([[0.96, 0.  , 0.96]])
    """

    name = "interval"

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """``|center - mean| / sd``, with distributions constant within bins."""
        away, spread = deviations(proba, widths)
        return np.asarray(np.abs(away) / spread[:, None], dtype=proba.dtype)


def deviations(proba: RealArray, widths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (n, K) of bins' middles from rows' means, and standard deviations (n,), in units of the widest bin."""
    shares = widths / widths.max()  # whose squares do not overflow
    centers = np.cumsum(shares) - shares / 2
    away = centers - (proba @ centers)[:, None]
    variance = (proba * away**2).sum(axis=1) + proba @ (shares**2 / 12)
    return away, np.sqrt(np.maximum(variance, np.finfo(np.float64).tiny))


class PartialLevelSet(NamedTuple):
    """What some of the bins of one row say about a level set."""

    mask: BoolArray  # (C,) bins in the set; none of targets that are not complete
    complete: BoolArray  # (d,) targets of which no other bin can be in the set


Order = Literal["probability", "density"]
_LIKELY = 1e-4  # of the best bin's density, or probability: other bins are rarely in a set
_ROUNDING = 1e-3  # of sums of probabilities in single precision, at most
_NAMES = {("probability", None): "aps", ("density", None): "hpd_random", ("density", 0.5): "hpd"}


class Aps:
    """Adaptive prediction sets: the probability of all more probable bins, and a share of the bin's own.

    Source: Romano, Sesia and Candes (2020). Ordered by density instead, these are the highest-density sets of
    Izbicki, Shimizu and Stern (2022): ``"hpd"`` is their mid-p version, in which half of the bin's own probability
    counts; ``"hpd_random"`` counts a random share.

    Parameters
    ----------
    order
        Bins are ranked by ``"probability"`` or ``"density"``.
    share
        Share of the bin's own probability that counts. None is a random one per row: a hash of its probabilities, so
        that the score is a fixed function of the sample, as the coverage guarantee needs. A fixed share makes sets
        robust to rounding: with 1, they are larger and never empty; with 0.5, as large on average as with random ones.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import Aps
    >>> proba, widths = np.array([[0.5, 0.3, 0.2]]), np.array([2.0, 1.0, 1.0])
    >>> Aps(share=1).of_bins(proba, widths)
    array([[0.5, 0.8, 1. ]])
    """

    normalised = True  # a share of the row's probability, whatever the target

    def __init__(self, order: Order = "probability", share: float | None = None) -> None:
        as_choice(order, Order, "order")
        if share is not None:
            check_number(share, "share", Range(0, 1, "(]"))
        self.order, self.share = order, share
        self.name = _NAMES.get((order, share), f"{'aps' if order == 'probability' else 'hpd'}_{share}")

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """Probability ranked before the bin, plus the share of the bin's own."""
        order = self.order_of(proba, widths)
        order += np.arange(0, proba.size, proba.shape[1])[:, None]
        scores = np.empty(proba.size, proba.dtype)
        share = row_uniforms(proba)[:, None].astype(proba.dtype) if self.share is None else proba.dtype.type(self.share)
        scores[order] = _ranked_scores(np.ascontiguousarray(proba).ravel()[order], share)
        return scores.reshape(proba.shape)

    def level_set(self, proba: FloatArray, widths: FloatArray, limits: RealArray, starts: IntArray) -> BoolArray:
        """Whether the score of each bin (C,) of one row is at most its target's limit (d,), as :meth:`of_bins` has it.

        The bins of d targets come one after another, those of each from `starts` (d,) on.
        """
        likely = _LIKELY * np.maximum.reduceat(self._keys(proba, widths), starts)
        mask, complete = self.level_set_above(proba, widths, limits, starts, likely)
        for j in np.flatnonzero(~complete).tolist():
            every = slice(starts[j], starts[j + 1] if j + 1 < len(starts) else None)
            mask[every] = self.of_bins(proba[None, every], widths[every])[0] <= limits[j]
        return mask

    def level_set_above(
        self, proba: FloatArray, widths: FloatArray, limits: RealArray, starts: IntArray, least: RealArray
    ) -> PartialLevelSet:
        """The same, from those bins alone whose density (or probability) is above the `least` (d,) of their target.

        There may be any number of others that are not given. Ranking few bins takes a tenth of the time.
        """
        keys, limits = self._keys(proba, widths), np.asarray(limits, np.float64)
        ends = np.array([*starts[1:].tolist(), len(proba)])
        ranked = np.flatnonzero(keys > np.repeat(least, ends - starts))
        target = np.searchsorted(starts, ranked, side="right") - 1
        order = ranked[np.lexsort((-keys[ranked], target))]  # ranked within targets: `target` stays as it is
        first, end = np.searchsorted(ranked, starts), np.searchsorted(ranked, ends)
        own, mask = proba[order], np.zeros(proba.shape, dtype=np.bool_)
        if self.share is None:
            return PartialLevelSet(mask, np.zeros(len(starts), dtype=np.bool_))
        before = np.concatenate(([0.0], np.cumsum(own)))
        complete = before[end] - before[first] > limits + _ROUNDING
        scores = before[:-1] - before[first][target] + self.share * own
        mask[order[(scores <= limits[target]) & complete[target]]] = True
        return PartialLevelSet(mask, complete)

    def order_of(self, proba: RealArray, widths: FloatArray) -> IntArray:
        """Bins from the best to the worst, (n, K)."""
        return np.argsort(-self._keys(proba, widths), axis=1, kind="stable")

    def _keys(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """What ranks bins: the larger, the better."""
        with np.errstate(over="ignore"):  # infinite densities rank first
            return proba if self.order == "probability" else np.asarray(proba / widths)


def _ranked_scores(ranked: RealArray, share: Any) -> RealArray:
    """Scores (n, K) of bins by rank; of their own probability a `share` counts, a number or (n, 1)."""
    before = np.cumsum(ranked, axis=1, dtype=ranked.dtype)
    before -= ranked
    before += share * ranked
    return np.asarray(np.maximum.accumulate(before, axis=1))


def row_uniforms(rows: RealArray) -> FloatArray:
    """One number in [0, 1) per row, a hash of its bits: equal rows get equal numbers."""
    bits = np.ascontiguousarray(rows, dtype=np.float64).view(np.uint64)
    odd = np.random.default_rng(0).integers(0, 2**63, size=rows.shape[1], dtype=np.uint64) * 2 + 1
    # the top bits of a float differ least between rows; folding brings them down before the multiplication
    hashed = ((bits ^ (bits >> np.uint64(32))) * odd).sum(axis=1, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashed = (hashed ^ (hashed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(((hashed ^ (hashed >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53)


BUILT_IN = (Lac, Density, Aps)
SCORES: dict[str, Score] = {
    score.name: score for score in (Lac(), Density(), Interval(), Aps(), Aps("density"), Aps("density", 0.5))
}


def register_score(score: Score) -> Score:
    """Make a score, such as an :class:`Aps` of another share, known by its name."""
    SCORES[score.name] = resolve_score(score)
    return score


def resolve_score(score: str | Score) -> Score:
    """A score object for a name from :data:`SCORES`, or the object itself."""
    if isinstance(score, str) and score in SCORES:
        return SCORES[score]
    if isinstance(score, str | type) or not callable(getattr(score, "of_bins", None)):
        names = ", ".join(sorted(SCORES))
        raise ConformodalError(f"score must be {names}, or an object with of_bins(proba, widths), got {brief(score)}")
    return score
