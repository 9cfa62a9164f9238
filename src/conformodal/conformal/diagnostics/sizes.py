"""How large sets are, and into how many pieces they fall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.conformal.errors import ConformalError
from conformodal.conformal.regions import Regions


@dataclass(frozen=True)
class SizeSummary:
    """Sizes of one target's sets.

    Attributes
    ----------
    mean, median, q90
        Length in the target's unit; ``inf`` where enough sets are the whole line.
    intervals
        Mean number of disjoint intervals.
    split, empty, unbounded
        Shares of the sets with more than one interval, with none, and of the whole line.
    """

    mean: float
    median: float
    q90: float
    intervals: float
    split: float
    empty: float
    unbounded: float


def summarise_sizes(regions: Regions) -> list[SizeSummary]:
    """One summary a target."""
    if len(regions) == 0:
        raise ConformalError("regions must hold at least one sample to be summarised")
    counts = regions.n_intervals
    found = []
    for length, count, whole in zip(regions.length.T, counts.T, regions.unbounded.T, strict=True):
        ranked = np.sort(length)
        at = [int(np.ceil(q * length.size)) - 1 for q in (0.5, 0.9)]
        shares = (float((count > 1).mean()), float((count == 0).mean()), float(whole.mean()))
        found.append(
            SizeSummary(float(length.mean()), float(ranked[at[0]]), float(ranked[at[1]]), float(count.mean()), *shares)
        )
    return found
