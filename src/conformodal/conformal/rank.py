"""The rank of split conformal prediction, computed exactly (the paper, section 2; Vovk et al. 2005)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import RealArray

from .checks import Alpha, as_alpha, as_count, as_scores
from .errors import ConformalError


def conformal_rank(n: int, alpha: Alpha) -> int:
    """Rank of the calibration score that is the threshold: ``ceil((n + 1) (1 - alpha))``, in rational arithmetic.

    Parameters
    ----------
    n
        Number of calibration scores, at least 0.
    alpha
        Miscoverage rate in (0, 1), read as the decimal it is written as.

    Returns
    -------
    int
        k between 1 and n + 1. ``k == n + 1`` means that no finite threshold gives the coverage: the region is
        unbounded.

    Examples
    --------
    >>> conformal_rank(99, 0.1)
    90
    >>> conformal_rank(8, 0.1)
    9
    """
    n, rate = as_count(n, "n"), as_alpha(alpha)
    return -((n + 1) * (rate.numerator - rate.denominator) // rate.denominator)  # a ceiling, in whole numbers


def conformal_quantile(scores: npt.ArrayLike, alpha: Alpha, axis: int = 0) -> RealArray:
    """k-th smallest score along `axis`, with k from :func:`conformal_rank`; ``+inf`` where k exceeds n.

    No interpolation: the result is one of the scores, in their own floating type.

    Parameters
    ----------
    scores
        Nonconformity scores. ``+inf`` is allowed and counts as the worst score.
    alpha
        Miscoverage rate in (0, 1).
    axis
        The axis over calibration samples.

    Returns
    -------
    ndarray
        `scores` without `axis`; 0-d for a vector.

    Examples
    --------
    >>> float(conformal_quantile([0.3, 0.1, 0.2], alpha=0.5))
    0.2
    >>> float(conformal_quantile([0.3, 0.1, 0.2], alpha=0.1))
    inf
    """
    arr = as_scores(scores)
    if arr.ndim == 0:
        raise ConformalError("scores must have at least one axis, got a scalar")
    axis = as_count(axis, "axis", -arr.ndim, arr.ndim - 1)
    arr = np.moveaxis(arr, axis, 0)
    n = arr.shape[0]
    k = conformal_rank(n, alpha)
    if k > n:
        return np.full(arr.shape[1:], np.inf, dtype=arr.dtype)
    return np.asarray(np.partition(arr, k - 1, axis=0)[k - 1])
