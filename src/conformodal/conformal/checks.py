"""Checks at the entry of the conformal core: arrays come out in one form, or an error names what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from numbers import Rational
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .blocks import for_blocks
from .errors import ConformalError

Alpha: TypeAlias = float | str | Decimal | Fraction
Probabilities: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]

# float16 softmax rows of a few hundred classes sum to one within about this
ROW_SUM_TOLERANCE = 5e-3


def as_alpha(alpha: Alpha, name: str = "alpha") -> Fraction:
    """Read a miscoverage rate as the decimal it is written as: ``0.1`` is one tenth, not 0.1000000000000000055.

    Raises
    ------
    ConformalError
        If `alpha` is no number strictly between 0 and 1.
    """
    try:
        if isinstance(alpha, bool):
            raise TypeError
        value = Fraction(alpha) if isinstance(alpha, (Rational, Decimal)) else Fraction(str(alpha))
    except (ValueError, TypeError, OverflowError):
        raise ConformalError(f"{name} must be a number strictly between 0 and 1, got {alpha!r}") from None
    if not 0 < value < 1:
        hint = f"; did you mean {1 - float(value) / 100:g}?" if 1 < value < 100 else ""
        raise ConformalError(f"{name} must lie strictly between 0 and 1 (a miscoverage rate), got {alpha}{hint}")
    return value


def as_targets(y: npt.ArrayLike, name: str = "y", n_targets: int | None = None) -> npt.NDArray[np.float64]:
    """Return `y` as a finite ``(n, d)`` float64 array; a vector is one target.

    Raises
    ------
    ConformalError
        On another shape, another number of targets than `n_targets`, or values that are not finite.
    """
    try:
        arr = np.asarray(y, dtype=np.float64)
    except (TypeError, ValueError) as exc:
        raise ConformalError(f"{name} must be numeric, got {type(y).__name__}: {exc}") from None
    if arr.ndim == 1:
        arr = arr[:, None]
    if arr.ndim != 2 or arr.shape[1] == 0:
        raise ConformalError(f"{name} must have shape (n,) or (n, d) with d >= 1, got {np.shape(y)}")
    if n_targets is not None and arr.shape[1] != n_targets:
        raise ConformalError(f"{name} has {arr.shape[1]} target(s), shape {np.shape(y)}; expected {n_targets}")
    if not np.isfinite(arr).all():
        row, col = np.argwhere(~np.isfinite(arr))[0]
        raise ConformalError(f"{name} must be finite, found {arr[row, col]} in row {row}, target {col}")
    return arr


def as_groups(groups: npt.ArrayLike, n: int, name: str = "groups") -> npt.NDArray[Any]:
    """Return one label a sample.

    Raises
    ------
    ConformalError
        On another shape than (n,), or NaN labels.
    """
    labels = np.asarray(groups)
    if labels.shape != (n,):
        raise ConformalError(f"{name} must have one label a sample, shape ({n},), got {labels.shape}")
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        raise ConformalError(f"{name} must not hold NaN")
    return labels


def as_probabilities(
    proba: Probabilities, n_bins: Sequence[int], name: str = "proba", check: bool = True
) -> list[npt.NDArray[np.floating[Any]]]:
    """Return one checked ``(n, K_j)`` array per target, without copying what is already an array.

    Parameters
    ----------
    proba
        ``(n, d, K)`` when all targets have K bins, ``(n, K)`` for a single target, or a list of d arrays
        ``(n, K_j)``.
    n_bins
        Bins per target, ``[K_1, ..., K_d]``.
    name
        What errors call the probabilities.
    check
        False leaves the values unchecked, and checks the shapes alone.

    Raises
    ------
    ConformalError
        On a shape that does not fit the bins, NaN, negative values, or rows that do not sum to one.
    """
    parts: list[npt.NDArray[Any]]
    d = len(n_bins)
    if isinstance(proba, (list, tuple)) and len(proba) == d and all(np.ndim(p) == 2 for p in proba):
        parts = [np.asarray(p) for p in proba]
    else:
        arr = np.asarray(proba)
        if arr.ndim == 2 and d == 1:
            arr = arr[:, None, :]
        if arr.ndim != 3 or arr.shape[1] != d:
            raise ConformalError(f"{name} must have shape (n, {d}, K) or be a list of {d} arrays, got {arr.shape}")
        parts = [arr[:, j] for j in range(d)]
    n = parts[0].shape[0]
    for j, (part, k) in enumerate(zip(parts, n_bins, strict=True)):
        if part.shape != (n, k):
            raise ConformalError(f"{name} of target {j} has shape {part.shape}, expected ({n}, {k}): {k} bins")
        if not np.issubdtype(part.dtype, np.floating):
            parts[j] = part.astype(np.float64)
        if check:
            check_rows(parts[j], f"{name} of target {j}")
    return parts


def check_rows(part: npt.NDArray[Any], name: str) -> None:
    """Check that rows (the last axis) are probabilities, block by block so that each is read from memory once.

    Raises
    ------
    ConformalError
        On NaN, negative values, or rows that do not sum to one.
    """
    for_blocks(part.shape[0], lambda rows: check_block(part[rows], name, rows.start))


def check_block(block: npt.NDArray[Any], name: str, first_row: int) -> None:
    """:func:`check_rows` for some rows, of which the first is row `first_row` of the whole."""
    if block.size == 0:
        return
    low = block.min()
    if not low >= 0:  # also catches NaN
        what = "NaN" if np.isnan(low) else f"negative values (smallest {low:g})"
        raise ConformalError(f"{name}, shape (..., {block.shape[-1]}), holds {what}; expected probabilities")
    # einsum reads memory at full speed where sum(axis=-1) does not; infinities end up in off as well
    sums = np.einsum("...k->...", block)
    off = np.abs(sums - 1).max(axis=tuple(range(1, sums.ndim)))
    if not (off <= ROW_SUM_TOLERANCE).all():
        row = int(np.argmax(~(off <= ROW_SUM_TOLERANCE)))
        total = sums[row].flat[np.abs(sums[row] - 1).argmax()]
        raise ConformalError(f"{name} must sum to 1 in every row; row {first_row + row} sums to {total:.6g}")
