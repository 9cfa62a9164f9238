"""Quantile bins of a continuous target: each holds the same share of the training data (the paper, section 2)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import RANGES, Range
from conformodal.core.words import counted

from .checks import as_doubles, as_finite, as_targets, brief, check_number, not_calibrated

# half the width, relative to the value's size, of the only bin of a target that never changes
_CONSTANT_HALF_WIDTH = 1e-6
# least standard deviation of a Gaussian over bin numbers; a narrower one is one-hot, its exponents would overflow
_MIN_SIGMA = 1e-100
_MIN_WIDTH = 1e-9  # of a distribution, as a share of the range of all bins
_SHARE_OF_RANGE = Range(0)
_TOO_FEW_DRAWS = 3  # of a distribution


class QuantileBins:
    """Bins between the K-quantiles of the training targets: narrow where the data is dense.

    Bin i holds ``edges[i] <= y < edges[i + 1]``; the last bin also holds its upper edge. A value on which several
    quantiles fall gets its own bin, which reaches half way to the neighbouring training values; a target may thus have
    fewer than `n_bins` bins. A constant target gets one bin, a millionth of its size wide on either side.

    Parameters
    ----------
    n_bins
        Bins per target (K in the paper), at least 1 and at most 100 000.
    margin
        Share of the training range by which the outer bins reach beyond it at either end. With 0, as in the paper,
        values beyond the training range score ``+inf``; a few such calibration values make regions unbounded at a
        small alpha.
    tail
        Width, as a share of the training range, of one more bin beyond the outer bin at either end; 0 for none. A
        smooth density gives these bins little probability, so that values far out get finite scores.
    y_min, y_max
        Bounds that no value can pass, such as 0 for a weight: one for all targets, or one per target.

    Attributes
    ----------
    edges_ : list of d arrays (K_d + 1,), strictly increasing, in the target's own unit
    names : the targets' names in tables and reports, or None
    limits : (d, 2) bounds of the targets, infinite if there are none: of unbounded sets, and of all bins

    Examples
    --------
    >>> from conformodal.conformal import QuantileBins
    >>> bins = QuantileBins(n_bins=2).fit([0.0, 0.1, 0.2, 5.0, 9.0])
    >>> bins.edges_[0]  # narrow where values are dense
    array([0. , 0.2, 9. ])
    >>> bins.encode([0.15, 7.0, 10.0])[:, 0]  # -1 lies outside
    array([ 0,  1, -1])
    """

    names: list[str] | None = None

    def __init__(
        self,
        n_bins: int = 50,
        margin: float = 0.0,
        tail: float = 0.0,
        y_min: npt.ArrayLike = -np.inf,
        y_max: npt.ArrayLike = np.inf,
    ) -> None:
        self.n_bins = n_bins
        self.margin = margin
        self.tail = tail
        self.y_min, self.y_max = y_min, y_max

    def check_parameters(self) -> None:
        """Refuse parameters that are not valid; ``fit`` calls this."""
        check_number(self.n_bins, "n_bins", RANGES["n_bins"])
        check_number(self.margin, "margin", _SHARE_OF_RANGE)
        check_number(self.tail, "tail", _SHARE_OF_RANGE)

    def fit(self, y: npt.ArrayLike) -> Self:
        """Place the edges at the K-quantiles of `y`, shape (n,) or (n, d)."""
        self.check_parameters()
        arr = as_targets(y)
        if len(arr) == 0:
            raise ConformodalError("y must hold at least one sample to place bins")
        self._bound(arr.shape[1])
        self.check_limits(arr)
        levels = np.linspace(0.0, 1.0, self.n_bins + 1)
        placed = []
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            for column, limits in zip(arr.T, self.limits, strict=True):
                edges = _place(np.quantile(column, levels), column)
                edges[[0, -1]] += self.margin * (edges[-1] - edges[0]) * np.array([-1.0, 1.0])
                if self.tail:
                    reach = self.tail * (edges[-1] - edges[0])
                    edges = np.concatenate(([edges[0] - reach], edges, [edges[-1] + reach]))
                placed.append(np.unique(np.clip(edges, *limits)))
        for j, edges in enumerate(placed):
            _check_edges(edges, f"bins of target {j}, values from {arr[:, j].min():g} to {arr[:, j].max():g}, edges")
        self.edges_ = placed
        return self

    @classmethod
    def from_edges(cls, edges: Sequence[npt.ArrayLike]) -> Self:
        """Bins with given edges: one strictly increasing vector per target."""
        arrays = [as_doubles(e, f"edges of target {j}").copy() for j, e in enumerate(edges)]
        if not arrays:
            raise ConformodalError("edges must hold one vector per target, at least one")
        for j, e in enumerate(arrays):
            _check_edges(e, f"edges of target {j}")
        bins = cls(max(e.size for e in arrays) - 1)
        bins.edges_ = arrays
        bins._bound(len(arrays))
        return bins

    def _bound(self, n_targets: int) -> None:
        ends = [as_doubles(end, name) for name, end in (("y_min", self.y_min), ("y_max", self.y_max))]
        if any(end.shape not in ((), (n_targets,)) for end in ends) or not (ends[0] < ends[1]).all():
            given = f"got {brief(self.y_min)} and {brief(self.y_max)}"
            raise ConformodalError(f"y_min must be below y_max, one number or one per target ({n_targets}); {given}")
        self.limits = np.stack([np.broadcast_to(end, n_targets) for end in ends], axis=1)

    def check_limits(self, y: FloatArray) -> None:
        """Refuse values (n, d) beyond the bounds."""
        beyond = (y < self.limits[:, 0]) | (y > self.limits[:, 1])
        if beyond.any():
            row, j = np.argwhere(beyond)[0]
            low, high = self.limits[j]
            raise ConformodalError(f"y must lie in [{low:g}, {high:g}], got {y[row, j]:g} in row {row}, target {j}")

    def _edges(self) -> list[FloatArray]:
        if not hasattr(self, "edges_"):
            raise not_calibrated("QuantileBins has no edges yet: call fit(y) or from_edges(edges) first")
        return self.edges_

    @property
    def n_targets(self) -> int:
        """Number of targets d."""
        return len(self._edges())

    @property
    def target_names(self) -> list[str]:
        """Names of the targets; numbered where arrays were given."""
        return self.names or [f"target {j}" for j in range(self.n_targets)]

    @property
    def sizes(self) -> list[int]:
        """Bins per target, ``[K_1, ..., K_d]``."""
        return [e.size - 1 for e in self._edges()]

    @property
    def widths(self) -> list[FloatArray]:
        """Width of every bin, one (K_d,) array per target."""
        return [np.diff(e) for e in self._edges()]

    @property
    def centers(self) -> list[FloatArray]:
        """Middle of every bin, one (K_d,) array per target."""
        return [(e[1:] + e[:-1]) / 2 for e in self._edges()]

    def encode(self, y: npt.ArrayLike) -> IntArray:
        """Codes of the bins that hold `y`: (n, d) integers, -1 outside the edges."""
        edges = self._edges()
        arr = as_targets(y, n_targets=len(edges))
        columns = [np.searchsorted(e, column, side="right") for e, column in zip(edges, arr.T, strict=True)]
        codes, last = np.stack(columns, axis=1) - 1, np.array([e.size - 2 for e in edges])
        codes = np.where(arr == [e[-1] for e in edges], last, codes)
        codes[codes > last] = -1
        return codes

    def proba_from_cdf(
        self, cdf: Callable[[float], npt.ArrayLike], target: int = 0, sf: Callable[[float], npt.ArrayLike] | None = None
    ) -> FloatArray:
        """Probabilities (n, K) of one target's bins; ``cdf(y)`` gives, for n samples, that of values up to `y`.

        Outer bins get what lies beyond them. Where ``cdf`` rounds to one, far above the median, all bins have
        probability zero and are equally bad; give the survival function ``sf``, as scipy.stats has it, to tell them
        apart.
        """
        edges = self._edges()[target][1:-1]
        if not edges.size:
            return np.ones((len(np.asarray(cdf(0.0))), 1))
        below = np.stack([as_finite(cdf(float(edge)), "cdf", "(n,)") for edge in edges], axis=1)
        if sf is None:
            return _differences(below, 1 - below)
        return _differences(below, np.stack([as_finite(sf(float(edge)), "sf", "(n,)") for edge in edges], axis=1))

    def proba_from_quantiles(self, levels: npt.ArrayLike, values: npt.ArrayLike, target: int = 0) -> FloatArray:
        """Probabilities (n, K) of one target's bins from quantiles, `values` (n, L) at the `levels` (L,).

        Distributions are uniform between quantiles. Beyond the outer ones they fall off exponentially. Quantiles
        that cross are sorted.
        """
        at, given = as_finite(levels, "levels", "(L,)"), np.sort(as_finite(values, "values", "(n, L)"), axis=1)
        if at.size < 2 or given.shape[1] != at.size or not (at[0] > 0 and (np.diff(at) > 0).all() and at[-1] < 1):
            raise ConformodalError(
                f"levels must increase in (0, 1), two or more, one per column of values, {brief(at)}"
            )
        edges = self._edges()[target][1:-1]
        below = np.stack([np.interp(edges, row, at) for row in given]) if len(given) else np.empty((0, edges.size))
        above = 1 - below
        for sign, end, inner, mass, step in (
            (1, 0, 1, at[0], at[1] - at[0]),
            (-1, -1, -2, 1 - at[-1], at[-1] - at[-2]),
        ):
            # the density goes on where it was; equal quantiles lend the width that all have on average
            usual = np.maximum(np.ptp(given, axis=1) / at.size, _MIN_WIDTH * np.ptp(self.edges_[target]))
            width = np.where(given[:, inner] == given[:, end], usual, np.abs(given[:, inner] - given[:, end]))
            beyond = sign * (given[:, [end]] - edges) / (width * mass / step)[:, None]
            tail = mass * np.exp(-np.maximum(beyond, 0))
            near, far = (below, above) if sign == 1 else (above, below)
            near[beyond > 0], far[beyond > 0] = tail[beyond > 0], 1 - tail[beyond > 0]
        return _differences(below, above)

    def proba_from_samples(self, samples: npt.ArrayLike, target: int = 0) -> FloatArray:
        """Probabilities (n, K) of one target's bins from draws (n, S) of each sample's distribution.

        The more draws, the more of their quantiles are taken: few smooth the chance out of which values were drawn.
        Up to three do not show how far values spread, and a warning says so.
        """
        draws = as_finite(samples, "samples", "(n, S)")
        if draws.shape[1] <= _TOO_FEW_DRAWS:
            each = counted(draws.shape[1], "draw")
            warnings.warn(
                f"samples: {each} per row cannot show how far values spread: one gives whole ranges, two or three give "
                "longer sets than need be. Give 20 or more",
                stacklevel=2,
            )
        n_levels = max(2, round(2 * draws.shape[1] ** 0.4))
        levels = (np.arange(n_levels) + 0.5) / n_levels
        return self.proba_from_quantiles(levels, np.quantile(draws, levels, axis=1).T, target)

    def soft_targets(self, y: npt.ArrayLike, sigma_bins: float) -> list[FloatArray]:
        """Order-aware class targets: a Gaussian over bin numbers around `y`; d arrays (n, K_d) whose rows sum to one.

        With one-hot targets a classifier invents modes, because bin 7 is as far from bin 8 as from bin 40, and loses
        where in its bin a value lies. ``sigma_bins=0`` gives the one-hot targets of the paper. A `y` outside the edges
        is clipped.
        """
        check_number(sigma_bins, "sigma_bins", RANGES["sigma_bins"])
        edges = self._edges()
        arr = as_targets(y, n_targets=len(edges))
        soft = []
        for values, e in zip(arr.T, edges, strict=True):
            k = e.size - 1
            if sigma_bins < _MIN_SIGMA:
                soft.append((np.arange(k) == nearest_bins(values, e)[:, None]) * 1.0)
                continue
            at = np.interp(values, e, np.arange(k + 1))
            log = -0.5 * ((np.arange(k) + 0.5 - at[:, None]) / sigma_bins) ** 2
            weights = np.exp(log - log.max(axis=1, keepdims=True))
            soft.append(weights / weights.sum(axis=1, keepdims=True))
        return soft


def _check_edges(edges: FloatArray, what: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        widths = np.diff(edges) if edges.ndim == 1 else np.empty(0)
    if widths.size == 0 or not (np.isfinite(widths) & (widths > 0)).all():
        raise ConformodalError(f"{what}: must be at least two, finite and strictly increasing, got {brief(edges)}")


def _differences(below: FloatArray, above: FloatArray) -> FloatArray:
    """Probabilities (n, K) of bins from those of values below and above the inner edges (n, K - 1).

    Above the median those above are differenced: those below round to one some 36 e-folds from there.
    """
    lower = np.pad(np.clip(below, 0, 1), ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1)))
    upper = np.pad(np.clip(above, 0, 1), ((0, 0), (1, 1)), constant_values=((0, 0), (1, 0)))
    steps = np.where(lower[:, :-1] > 0.5, -np.diff(upper, axis=1), np.diff(lower, axis=1))
    return np.asarray(np.maximum(steps, 0))


def nearest_bins(values: FloatArray, edges: FloatArray) -> IntArray:
    """Bins (n,) of one target's values; values beyond the edges are in the outer bins."""
    return np.searchsorted(edges[1:-1], values, side="right")


def _place(quantiles: FloatArray, values: FloatArray) -> FloatArray:
    """Strictly increasing edges at `quantiles`; a value on which several of them fall gets its own bin."""
    edges, counts = np.unique(quantiles, return_counts=True)
    if edges.size == 1:
        half = _CONSTANT_HALF_WIDTH * max(1.0, abs(float(edges[0])))
        return np.array([edges[0] - half, edges[0] + half])
    repeated = edges[counts > 1]
    if repeated.size == 0:
        return edges
    distinct = np.unique(values)
    at = np.searchsorted(distinct, repeated)
    above = (repeated + distinct[np.minimum(at + 1, distinct.size - 1)]) / 2
    below = (repeated + distinct[np.maximum(at - 1, 0)]) / 2
    below = np.where(at == 0, 2 * repeated - above, below)
    above = np.where(at == distinct.size - 1, 2 * repeated - below, above)
    covered = np.searchsorted(below, edges, side="right") - np.searchsorted(above, edges, side="left")
    return np.unique(np.concatenate((edges[covered == 0], below, above)))
