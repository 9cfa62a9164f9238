"""Thresholds from whole groups of scores, such as recordings, whose members are not exchangeable with each other.

Lee, Barber and Willett 2023, "Distribution-free inference with hierarchical data".
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from math import lcm

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, as_alpha, as_count, as_doubles, as_scores
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.rank import conformal_quantile
from conformodal.core.arrays import FloatArray


def grouped_quantile(groups: Sequence[npt.ArrayLike], alpha: Alpha, sizes: Sequence[int] | None = None) -> float:
    """Threshold that a member of a new group, drawn at random, exceeds with probability at most `alpha`.

    Every group has the same weight, shared by its members; the new group counts as ``+inf``. If groups are exchangeable
    (their members need not be), coverage is guaranteed in a new group, on average over its members. Sums are exact.
    With groups of one this is :func:`~conformodal.conformal_quantile`.

    Parameters
    ----------
    groups
        K vectors of nonconformity scores, none empty; ``+inf`` is allowed.
    alpha
        Miscoverage rate in (0, 1).
    sizes
        (K,) sizes of the whole groups if only members of one category are given: each member keeps its weight in the
        whole group, and a member of a new group is of the category and beyond the threshold with probability at most
        `alpha` times the weight of the category. By default all members are given.

    Returns
    -------
    float
        One of the scores, or ``+inf`` if the members weigh less than ``1 / alpha - 1`` whole groups.

    Examples
    --------
    >>> grouped_quantile([[1, 2, 3, 9], [2, 2, 8], [4, 5]], alpha=0.4)
    5.0
    """
    rate = as_alpha(alpha)
    arrays = _as_groups(groups)
    if not arrays:
        return float("inf")
    scores = np.concatenate(arrays)
    order = np.argsort(scores, kind="stable")
    counts = [a.size for a in arrays]
    members = counts if sizes is None else [as_count(size, f"size of group {i}") for i, size in enumerate(sizes)]
    if len(members) != len(counts) or any(m < c for m, c in zip(members, counts, strict=True)):
        raise ConformalError(f"sizes must be at least those of the groups, {counts}, got {members}")
    # in units of 1 / whole, so that every member's weight is a whole number
    whole = lcm(*members)
    weights = np.repeat(np.array([whole // m for m in members], dtype=object), counts)
    total = sum(whole // m * c for m, c in zip(members, counts, strict=True))
    need = -((total + whole) * (rate.numerator - rate.denominator) // rate.denominator)
    for at, reached in zip(order, accumulate(weights[order]), strict=True):
        if reached >= need:
            return float(scores[at])
    return float("inf")


def grouped_maximum_quantile(groups: Sequence[npt.ArrayLike], alpha: Alpha) -> float:
    """Threshold that all members of a new group keep below with probability at least ``1 - alpha``.

    The conformal quantile of the groups' maxima; parameters, result and errors as for :func:`grouped_quantile`.

    Examples
    --------
    >>> grouped_maximum_quantile([[1, 2, 3, 9], [2, 2, 8], [4, 5]], alpha=0.5)
    8.0
    """
    return float(conformal_quantile([a.max() for a in _as_groups(groups)], alpha))


def _as_groups(groups: Sequence[npt.ArrayLike]) -> list[FloatArray]:
    try:
        arrays = [as_doubles(as_scores(group, f"group {i}"), f"group {i}") for i, group in enumerate(groups)]
    except TypeError:
        raise ConformalError(f"groups must hold one vector of scores per group, got {type(groups).__name__}") from None
    for i, array in enumerate(arrays):
        if array.ndim != 1 or array.size == 0:
            raise ConformalError(f"group {i} must be a vector of at least one score, got shape {array.shape}")
    return arrays
