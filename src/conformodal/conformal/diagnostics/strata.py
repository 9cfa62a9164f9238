"""Coverage by group, and by the size of the set: where an average may hide a failure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..checks import Alpha, as_groups
from ..errors import ConformalError
from .coverage import CoverageCheck, check_coverage

BoolArray = npt.NDArray[np.bool_]


def coverage_by_group(
    inside: BoolArray, groups: npt.ArrayLike, n_calibration: int, alpha: Alpha, level: float = 0.99
) -> dict[str, CoverageCheck]:
    """Coverage of every group of test samples.

    Split conformal prediction promises nothing for a group alone. The band is that of a group named in advance whose
    scores are distributed like everyone's: coverage outside it says that this group differs. Of G groups about
    ``G (1 - level)`` fall outside by chance.

    Parameters
    ----------
    inside
        (n_test,) whether each true value is in its set.
    groups
        (n_test,) labels.
    n_calibration, alpha, level
        As in :func:`check_coverage`.

    Raises
    ------
    ConformalError
        If `groups` has another length, or holds NaN.
    """
    labels = as_groups(groups, inside.shape[0])
    return {
        str(label): check_coverage(inside[labels == label], n_calibration, alpha, level) for label in np.unique(labels)
    }


def coverage_by_size(
    inside: BoolArray,
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

    Raises
    ------
    ConformalError
        If `sizes` has another length or holds NaN, or `strata` is below 1.
    """
    values = np.asarray(sizes, dtype=np.float64)
    if values.shape != inside.shape:
        raise ConformalError(f"sizes must have shape {inside.shape}, one a sample, got {values.shape}")
    if np.isnan(values).any():
        raise ConformalError("sizes must not hold NaN")
    if strata < 1:
        raise ConformalError(f"strata must be at least 1, got {strata}")
    values = np.array([float(f"{v:.12g}") for v in values])  # sums of the same widths in another order are one size
    ranked = np.sort(values)
    cuts = np.unique(ranked[(np.arange(1, strata) * values.size) // strata])
    stratum = np.searchsorted(cuts, values, side="right")
    found = {}
    for s in np.unique(stratum):
        own = stratum == s
        low, high = values[own].min(), values[own].max()
        name = f"{low:.4g} to {high:.4g}" if low < high else f"{low:.4g}"
        found[name if name not in found else f"{low!r} to {high!r}"] = check_coverage(
            inside[own], n_calibration, alpha, level
        )
    return found
