"""Sets of at most k intervals: the shortest ones of a given probability, and a nested family around them."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

from .checks import Alpha, as_alpha, as_count
from .scores import Aps

# probabilities are rounded to multiples of one over this: a shortest set is exact to k of them
_PARTS = 200
_ROWS_AT_ONCE = 256


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
        self.k, self.alpha = as_count(k, "max_intervals", 1), alpha
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
