"""Nonconformity scores of bins: the lower, the better a bin fits. For a new score see :class:`Score`."""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import Alpha, as_alpha, as_choice, brief, check_number

# probabilities are rounded to multiples of one over this: a shortest set is exact to k of them
_PARTS = 200
_ROWS_AT_ONCE = 256


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


Order = Literal["probability", "density"]
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
        ranked = np.take_along_axis(proba, order, axis=1)
        share = row_uniforms(proba)[:, None].astype(proba.dtype) if self.share is None else proba.dtype.type(self.share)
        before = np.cumsum(ranked, axis=1, dtype=proba.dtype) - ranked
        scores = np.empty_like(proba)
        np.put_along_axis(scores, order, np.maximum.accumulate(before + share * ranked, axis=1), axis=1)
        return scores

    def order_of(self, proba: RealArray, widths: FloatArray) -> IntArray:
        """Bins from the best to the worst, (n, K)."""
        with np.errstate(over="ignore"):  # infinite densities rank first
            keys = proba if self.order == "probability" else proba / widths
        return np.argsort(-keys, axis=1, kind="stable")


def row_uniforms(rows: RealArray) -> FloatArray:
    """One number in [0, 1) per row, a hash of its bits: equal rows get equal numbers."""
    bits = np.ascontiguousarray(rows, dtype=np.float64).view(np.uint64)
    odd = np.random.default_rng(0).integers(0, 2**63, size=rows.shape[1], dtype=np.uint64) * 2 + 1
    # the top bits of a float differ least between rows; folding brings them down before the multiplication
    hashed = ((bits ^ (bits >> np.uint64(32))) * odd).sum(axis=1, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        hashed = (hashed ^ (hashed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(((hashed ^ (hashed >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53)


class MaxIntervals(Aps):
    """Highest-density sets of at most `k` intervals.

    A row's sets are nested around its shortest set of at most `k` intervals with probability ``1 - alpha``, which a
    dynamic programme over the bins finds. Smaller sets lose its bins of least density, larger ones gain bins of most
    density, as far as `k` intervals allow. A bin scores the probability of the sets that it is not in, and half its
    own: so calibration at any rate gives sets of at most `k` intervals, with exact coverage.

    Source: Gao, Shan, Srinivas and Vijayaraghavan (2025), who give the programme and the nested family.

    Parameters
    ----------
    k
        Most intervals of a set, at least 1.
    alpha
        Miscoverage rate at which sets are shortest, if the probabilities are right.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import MaxIntervals
    >>> proba, widths = np.array([[0.4, 0.1, 0.3, 0.2]]), np.ones(4)
    >>> MaxIntervals(2, alpha=0.3).of_bins(proba, widths).round(2)  # first and third bin, then their neighbours
    array([[0.2 , 0.95, 0.55, 0.8 ]])
    """

    def __init__(self, k: int, alpha: Alpha = 0.1) -> None:
        super().__init__("density", share=0.5)
        self.k, self.alpha = check_number(k, "max_intervals", Range(1, whole=True)), alpha
        self._mass = 1 - float(as_alpha(alpha))
        self.name = "max_intervals"

    def order_of(self, proba: RealArray, widths: FloatArray) -> IntArray:
        """Bins in the order in which they join the sets, (n, K)."""
        order = np.empty(proba.shape, dtype=np.int64)
        for start in range(0, len(proba), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            part = proba[rows].astype(np.float64)
            order[rows] = _nested(part / widths, shortest_sets(part, widths, self._mass, self.k), self.k)
        return order


def shortest_sets(proba: FloatArray, widths: FloatArray, mass: float, k: int) -> BoolArray:
    """The shortest sets of at most `k` intervals with a probability of `mass`, as masks (n, K).

    Probabilities are rounded, so that a set may have less than `mass` by a 200th per interval.
    """
    n, n_bins = proba.shape
    ends = np.floor(_PARTS * np.minimum(np.cumsum(proba, axis=1), 1) + 1e-9)
    ends[:, -1] = _PARTS
    parts = np.diff(np.pad(ends, ((0, 0), (1, 0))), axis=1).astype(np.int64)
    most = int(np.ceil(round(_PARTS * mass, 9)))
    # least length (k + 1, n, most + 1) of sets of the bins so far, by intervals and by the parts they must have;
    # `closed` of all sets, `taken` of those with the latest bin
    closed = np.full((k + 1, n, most + 1), np.inf)
    closed[:, :, 0] = 0
    taken = np.full_like(closed, np.inf)
    starts, takes = np.zeros((2, n_bins, *closed.shape), dtype=bool)
    place = np.arange(n)[:, None] * (most + 1)
    for i in range(n_bins):
        rest = place + np.maximum(np.arange(most + 1) - parts[:, i, None], 0)
        extend = taken[1:].reshape(k, -1)[:, rest]
        start = closed[:-1].reshape(k, -1)[:, rest]
        np.less(start, extend, out=starts[i, 1:])
        np.add(np.minimum(extend, start), widths[i], out=taken[1:])
        np.less(taken, closed, out=takes[i])
        np.minimum(closed, taken, out=closed)
    chosen, rows = np.zeros((n, n_bins), dtype=bool), np.arange(n)
    count, needed, inside = np.full(n, k), np.full(n, most), np.zeros(n, dtype=bool)
    for i in range(n_bins - 1, -1, -1):
        taken_now = inside | takes[i, count, rows, needed]
        chosen[:, i] = taken_now
        first = taken_now & starts[i, count, rows, needed]
        needed = np.where(taken_now, np.maximum(needed - parts[:, i], 0), needed)
        count, inside = count - first, taken_now & ~first
    return chosen


def _nested(density: FloatArray, anchor: BoolArray, k: int) -> IntArray:
    """Order (n, K) in which bins join, of at most `k` runs at any time; those of `anchor` come first."""
    n, n_bins = density.shape
    order, size = np.empty((n, n_bins), dtype=np.int64), anchor.sum(axis=1)
    for grow in (True, False):
        mask, turn = np.pad(anchor, ((0, 0), (1, 1))), size.copy() if grow else size - 1
        while True:
            rows = np.flatnonzero(turn < n_bins if grow else turn >= 0)
            if not rows.size:
                break
            inside, beside = mask[rows, 1:-1], mask[rows, 2:].astype(np.int8) + mask[rows, :-2]
            spare = ((inside & ~mask[rows, :-2]).sum(axis=1) < k)[:, None]
            free = ~inside & ((beside > 0) | spare) if grow else inside & ((beside < 2) | spare)
            worth = np.where(free, density[rows] if grow else -density[rows], -np.inf)
            # an infinite density is as good as the largest
            bin_ = np.where(free, np.nan_to_num(worth), -np.inf).argmax(axis=1)
            order[rows, turn[rows]], mask[rows, bin_ + 1] = bin_, grow
            turn[rows] += 1 if grow else -1
    return order


BUILT_IN = (Lac, Density, Aps)
SCORES: dict[str, Score] = {
    score.name: score for score in (Lac(), Density(), Aps(), Aps("density"), Aps("density", 0.5))
}


def register_score(score: Score) -> Score:
    """Make a score, such as an :class:`Aps` of another share, known by its name."""
    SCORES[score.name] = resolve_score(score)
    return score


def resolve_score(score: str | Score) -> Score:
    """A score object for a name from :data:`SCORES`, or the object itself."""
    if isinstance(score, str):
        if score not in SCORES:
            raise ConformodalError(f"score must be one of {sorted(SCORES)} or a Score object, got {brief(score)}")
        return SCORES[score]
    if isinstance(score, type) or not callable(getattr(score, "of_bins", None)):
        raise ConformodalError(f"score must be a name or an object with of_bins(proba, widths), got {brief(score)}")
    return score


def is_per_unit(score: Score) -> bool:
    """Whether scores have a unit, one over that of the target."""
    return bool(getattr(score, "per_unit", False))
