"""Sets as closed intervals, and what is measured of them; the same code for every method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from problems import Split

from common import excess_risk  # isort: skip - problems makes it importable

from conformodal.core.arrays import FloatArray


@dataclass
class Sets:
    """Closed intervals ``[low, high]`` of sample ``rows[i]``; disjoint within a sample."""

    n: int
    rows: npt.NDArray[np.int64]
    low: FloatArray
    high: FloatArray


def one_interval(low: npt.ArrayLike, high: npt.ArrayLike) -> Sets:
    """Sets of one interval each; one whose ends are crossed is empty."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    keep = np.flatnonzero(a <= b)
    return Sets(len(a), keep, a[keep], b[keep])


def measure(sets: Sets, split: Split, alpha: float) -> dict[str, float | None]:
    """Coverage (also in the hardest quarter, and how far it can be predicted), size and components.

    Size is length; for a target on a grid it is the grid values held, each counted as wide as its cell (half way to
    its neighbours), so that a set of single values is not called shorter than an interval that holds no more of them.
    """
    y, grid, inside = split.y["test"], split.grid, np.zeros(sets.n, dtype=bool)
    truth = y[sets.rows]
    inside[sets.rows[(sets.low <= truth) & (truth <= sets.high)]] = True
    if grid is None:
        sizes = sets.high - sets.low
    else:
        middles = (grid[1:] + grid[:-1]) / 2
        ends = np.concatenate(([grid[0] - (middles[0] - grid[0])], middles, [grid[-1] + (grid[-1] - middles[-1])]))
        reach = np.concatenate(([0.0], np.cumsum(np.diff(ends))))
        sizes = reach[np.searchsorted(grid, sets.high, "right")] - reach[np.searchsorted(grid, sets.low, "left")]
    return {
        "covered": int(inside.sum()),
        "hardest quarter": float(inside[split.hardest].mean()),
        "excess risk": excess_risk(split.X["test"], inside, alpha),
        "size": float(np.bincount(sets.rows, sizes, minlength=sets.n).mean()),
        "components": float(sets.rows.size / sets.n),
    }
