"""The rank of split conformal prediction, computed exactly (the paper, section 2; Vovk et al. 2005)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import RealArray

from .checks import Alpha, as_alpha, as_scores
from .errors import ConformalError
from .scalars import as_count

MANY = 20_000_000  # scores, of which a copy is avoided
_ROWS, _DIGIT = 1 << 20, 16


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

    Raises
    ------
    ConformalError
        If `n` is negative or not an integer, or `alpha` is outside (0, 1).

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
        Nonconformity scores. ``+inf`` is allowed and counts as the worst score. A vector may be a memory-mapped file:
        of very many scores no copy is made.
    alpha
        Miscoverage rate in (0, 1).
    axis
        The axis over calibration samples.

    Returns
    -------
    ndarray
        `scores` without `axis`; 0-d for a vector.

    Raises
    ------
    ConformalError
        If `scores` is a scalar or holds NaN, or `alpha` is outside (0, 1).

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
    if arr.ndim == 1 and n > MANY:
        return kth_smallest(arr, k)
    return np.asarray(np.partition(arr, k - 1, axis=0)[k - 1])


def kth_smallest(values: npt.NDArray[np.floating[Any]], k: int) -> npt.NDArray[np.floating[Any]]:
    """The k-th smallest, from 1, of a vector without NaN, which may be a mapped file, without a sorted copy.

    The bits of floats, read as integers, have the order of the floats once those of negative ones are inverted. The
    number is found sixteen bits at a time from the highest: each pass counts, block by block, the digits of the numbers
    that begin with the digits found so far. This takes a few megabytes, whatever the size of the vector.
    """
    unsigned = np.dtype(f"u{values.dtype.itemsize}")
    found, left = 0, k  # the digits so far, and the rank among the numbers that begin with them
    for shift in range(8 * unsigned.itemsize - _DIGIT, -1, -_DIGIT):
        counts = np.zeros(1 << _DIGIT, dtype=np.int64)
        for start in range(0, values.size, _ROWS):
            places = _in_order(values[start : start + _ROWS], unsigned) >> unsigned.type(shift)
            if shift + _DIGIT < 8 * unsigned.itemsize:
                places = places[places >> unsigned.type(_DIGIT) == found]
            counts += np.bincount((places & unsigned.type((1 << _DIGIT) - 1)).astype(np.int64), minlength=1 << _DIGIT)
        reached = np.cumsum(counts)
        digit = int(np.searchsorted(reached, left))
        left -= int(reached[digit] - counts[digit])
        found = (found << _DIGIT) | digit
    top = 1 << (8 * unsigned.itemsize - 1)
    bits = found ^ top if found & top else found ^ (2 * top - 1)
    return np.array([bits], dtype=unsigned).view(values.dtype).reshape(())


def _in_order(block: npt.NDArray[np.floating[Any]], unsigned: np.dtype[Any]) -> npt.NDArray[Any]:
    """Integers in the order of the floats; both zeros are the same."""
    bits = (block + block.dtype.type(0)).view(unsigned)  # minus zero plus zero is zero
    top = unsigned.type(1 << (8 * unsigned.itemsize - 1))
    return np.where(bits & top, ~bits, bits | top)
