"""Coverage by group and by set size, where the average coverage may hide a failure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, as_doubles, as_flags
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.grouping import as_groups, factorise
from conformodal.conformal.scalars import as_count

from .coverage import CoverageCheck, check_coverage


def coverage_by_group(
    inside: npt.ArrayLike, groups: npt.ArrayLike, n_calibration: int, alpha: Alpha, level: float = 0.99
) -> dict[str, CoverageCheck]:
    """Coverage of every group of test samples.

    Split conformal prediction guarantees nothing for a group alone. The band is that of a group named in advance whose
    scores are distributed like everyone's: coverage outside it says that this group differs. Of G groups about
    ``G (1 - level)`` fall outside by chance.

    Parameters
    ----------
    inside
        (n_test,) whether each true value is in its set.
    groups
        (n_test,) labels, see :func:`~conformodal.conformal.grouping.as_groups`.
    n_calibration, alpha, level
        As in :func:`check_coverage`.
    """
    held = as_flags(inside, "inside", 1)
    labels, codes = factorise(as_groups(groups, held.size))
    names = [str(label) for label in labels]
    if len(set(names)) < len(names):  # 1 and "1"
        names = [repr(label) for label in labels]
    return {name: check_coverage(held[codes == k], n_calibration, alpha, level) for k, name in enumerate(names)}


def coverage_by_size(
    inside: npt.ArrayLike,
    sizes: npt.ArrayLike,
    n_calibration: int,
    alpha: Alpha,
    strata: int = 5,
    level: float = 0.99,
) -> dict[str, CoverageCheck]:
    """Coverage of the samples with the smallest sets, the next larger, and so on.

    Sets that are small where they should be large show as strata below their bands. Equal sizes share a stratum, so
    there may be fewer than asked for.

    Source: Angelopoulos, Bates, Malik and Jordan (2021), size-stratified coverage.

    Parameters
    ----------
    inside
        (n_test,) whether each true value is in its set.
    sizes
        (n_test,) lengths or volumes.
    n_calibration, alpha, level
        As in :func:`check_coverage`; on the band see :func:`coverage_by_group`.
    strata
        Strata of about equal numbers of samples.
    """
    held, values = as_flags(inside, "inside", 1), as_doubles(sizes, "sizes")
    if values.shape != held.shape:
        raise ConformalError(f"sizes must have shape {held.shape}, one a sample, got {values.shape}")
    if np.isnan(values).any():
        raise ConformalError("sizes must not hold NaN")
    strata = as_count(strata, "strata", 1)
    values = np.array([float(f"{v:.12g}") for v in values])  # sums of the same widths in another order are one size
    ranked = np.sort(values)
    strata = min(strata, max(values.size, 1))
    cuts = np.unique(ranked[(np.arange(1, strata) * values.size) // strata])
    stratum = np.searchsorted(cuts, values, side="right")
    found = {}
    for s in np.unique(stratum):
        own = stratum == s
        low, high = values[own].min(), values[own].max()
        name = f"{low:.4g} to {high:.4g}" if low < high else f"{low:.4g}"
        found[name if name not in found else f"{low!r} to {high!r}"] = check_coverage(
            held[own], n_calibration, alpha, level
        )
    return found
