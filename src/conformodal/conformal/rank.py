"""Thresholds from calibration scores, computed exactly: of samples, or of units such as recordings.

Sources: the paper, section 2; Vovk et al. (2005); for units whose members are not exchangeable with each other, Lee,
Barber and Willett (2023), "Distribution-free inference with hierarchical data".
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from math import lcm

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import Alpha, as_alpha, as_scores, brief, check_number


def conformal_rank(n: int, alpha: Alpha) -> int:
    """Rank of the calibration score that is the threshold: ``ceil((n + 1) (1 - alpha))``, in rational arithmetic.

    `alpha` is read as the decimal it is written as. A rank of n + 1 means that no finite threshold gives the coverage:
    the region is unbounded.

    Examples
    --------
    >>> conformal_rank(99, 0.1)
    90
    >>> conformal_rank(8, 0.1)
    9
    """
    n, rate = int(check_number(n, "n", Range(0, whole=True))), as_alpha(alpha)
    return -((n + 1) * (rate.numerator - rate.denominator) // rate.denominator)  # a ceiling, in whole numbers


def conformal_quantile(scores: npt.ArrayLike, alpha: Alpha, axis: int = 0) -> RealArray:
    """k-th smallest score along `axis`, with k from :func:`conformal_rank`; ``+inf`` where k exceeds n.

    No interpolation: the result is one of the scores, in their own floating type, with the shape of `scores` without
    `axis`. A score of ``+inf`` counts as the worst.

    Examples
    --------
    >>> float(conformal_quantile([0.3, 0.1, 0.2], alpha=0.5))
    0.2
    >>> float(conformal_quantile([0.3, 0.1, 0.2], alpha=0.1))
    inf
    """
    arr = as_scores(scores)
    if not -arr.ndim <= axis < arr.ndim:
        raise ConformodalError(f"scores of shape {arr.shape} have no axis {axis}")
    arr = np.moveaxis(arr, axis, 0)
    k = conformal_rank(len(arr), alpha)
    if k > len(arr):
        return np.full(arr.shape[1:], np.inf, dtype=arr.dtype)
    return np.asarray(np.partition(arr, k - 1, axis=0)[k - 1])


def hierarchical_quantile(units: Sequence[npt.ArrayLike], alpha: Alpha, sizes: Sequence[int] | None = None) -> float:
    """Threshold that a member of a new unit, drawn at random, exceeds with probability at most `alpha`.

    `units` are K vectors of nonconformity scores, none empty. Every unit has the same weight, shared by its members;
    the new unit counts as ``+inf``. If units are exchangeable (their members need not be), coverage is guaranteed in a
    new unit, on average over its members. Sums are exact; with units of one this is
    :func:`~conformodal.conformal_quantile`. The threshold is ``+inf`` if the members weigh less than ``1 / alpha - 1``
    whole units.

    `sizes` (K,) are those of the whole units if only members of one category are given: each member keeps its weight in
    the whole unit, and a member of a new unit is of the category and beyond the threshold with probability at most
    `alpha` times the weight of the category.

    Examples
    --------
    >>> hierarchical_quantile([[1, 2, 3, 9], [2, 2, 8], [4, 5]], alpha=0.4)
    5.0
    """
    rate, arrays = as_alpha(alpha), _as_units(units)
    if not arrays:
        return float("inf")
    scores = np.concatenate(arrays)
    order = np.argsort(scores, kind="stable")
    counts = [a.size for a in arrays]
    members = counts if sizes is None else list(sizes)
    if len(members) != len(counts) or any(m < c or m % 1 for m, c in zip(members, counts, strict=True)):
        raise ConformodalError(f"sizes must be at least those of the units, {brief(counts)}, got {brief(members)}")
    # in units of 1 / whole, so that every member's weight is a whole number
    whole = lcm(*members)
    weights = np.repeat(np.array([whole // m for m in members], dtype=object), counts)
    total = sum(whole // m * c for m, c in zip(members, counts, strict=True))
    need = -((total + whole) * (rate.numerator - rate.denominator) // rate.denominator)
    for at, reached in zip(order, accumulate(weights[order]), strict=True):
        if reached >= need:
            return float(scores[at])
    return float("inf")


def _as_units(units: Sequence[npt.ArrayLike]) -> list[FloatArray]:
    try:
        arrays = [as_scores(unit, f"unit {i}").astype(np.float64, copy=False) for i, unit in enumerate(units)]
    except TypeError:
        raise ConformodalError(f"units must hold one vector of scores per unit, got {brief(units)}") from None
    for i, array in enumerate(arrays):
        if array.ndim != 1 or array.size == 0:
            raise ConformodalError(f"unit {i} must be a vector of at least one score, got shape {array.shape}")
    return arrays
