"""Checks of arguments: arrays come out in one form, or an error names what is wrong.

Every array passes :func:`as_reals`, which returns real numbers of native byte order, float32 or float64. Strings, dates
and masked entries, which NumPy and scikit-learn would convert, are refused.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse

from conformodal.core.arrays import BoolArray, FloatArray, RealArray
from conformodal.core.words import counted

from .errors import ConformalError
from .scalars import Alpha, as_alpha, brief

Probabilities: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]

__all__ = ["Alpha", "as_alpha"]

# float16 softmax rows of a few hundred classes sum to one within about this
_ROW_SUM_TOLERANCE = 5e-3
_DEEPEST_LIST = 4
_BLOCK_ROWS = 4096
_ROWS_WORTH_THREADS = 1 << 16


def as_array(values: Any, name: str) -> npt.NDArray[Any]:
    """Any array-like as an array of any dtype; masked entries, which NumPy would drop, are refused."""
    _refuse_masked(values, name)
    if issparse(values):
        raise ConformalError(f"{name} must be a dense array, got a sparse one: call its toarray() first")
    try:
        if callable(getattr(values, "detach", None)):  # a tensor of torch, with a gradient or on a device
            values = values.detach().cpu()
            if "float8" in str(values.dtype) or "bfloat16" in str(values.dtype):
                values = values.float()  # NumPy has no such type; float32 holds all its numbers
        return np.asarray(values)
    except MemoryError:
        raise
    except Exception as exc:  # whatever a foreign class raises
        why = " ".join(str(exc).split())
        raise ConformalError(f"{name} cannot be read as an array, got {type(values).__name__}: {why}") from None


def _refuse_masked(values: Any, name: str, depth: int = 0) -> None:
    if isinstance(values, np.ma.MaskedArray) and values.dtype.names is None:
        mask = np.ma.getmaskarray(values)
        if mask.any():
            at = np.argwhere(mask)[0].tolist()
            raise ConformalError(f"{name} must not hold masked entries, found one at position {at}")
    elif isinstance(values, (list, tuple)) and depth < _DEEPEST_LIST:
        for value in values:
            if isinstance(value, (list, tuple, np.ma.MaskedArray)):
                _refuse_masked(value, name, depth + 1)


def as_reals(values: Any, name: str) -> RealArray:
    """Any array-like of real numbers as a float32 or float64 array of native byte order, not copied if it is one.

    float16 becomes float32; integers, booleans, ``longdouble`` and objects become float64.
    """
    if type(values) is np.ndarray and values.dtype.char in "fd" and values.dtype.isnative:
        return values
    arr = as_array(values, name)
    if arr.dtype.kind == "O":
        return _from_objects(arr, name)
    if arr.dtype.kind not in "biuf":
        raise ConformalError(f"{name} must be numeric, of real numbers, got dtype {arr.dtype}")
    short = arr.dtype.kind == "f" and arr.dtype.itemsize <= 4
    with np.errstate(over="ignore"):
        found: RealArray = arr.astype(np.float32, copy=False) if short else arr.astype(np.float64, copy=False)
    if arr.dtype.itemsize > 8 and not np.array_equal(np.isinf(found), np.isinf(arr)):
        raise ConformalError(f"{name} holds a number too large for float64, dtype {arr.dtype}")
    return found


def _from_objects(arr: npt.NDArray[Any], name: str) -> FloatArray:
    found = np.empty(arr.shape)
    for at, value in np.ndenumerate(arr):
        place = f" at position {list(at)}" if at else ""
        if not isinstance(value, (Real, Decimal, np.bool_)):
            what = brief(value) if value is None or isinstance(value, (str, complex)) else type(value).__name__
            raise ConformalError(f"{name} must be numeric, of real numbers, found {what}{place}")
        try:
            found[at] = float(value)
        except (OverflowError, ValueError):
            raise ConformalError(f"{name} holds a number too large for float64{place}") from None
    return found


def as_doubles(values: Any, name: str) -> FloatArray:
    """:func:`as_reals` in float64."""
    return as_reals(values, name).astype(np.float64, copy=False)


def as_finite(values: Any, name: str, shape: str) -> FloatArray:
    """Finite numbers in float64, with as many axes as `shape`, such as ``"(n, k)"``, has letters."""
    arr = as_doubles(values, name)
    if arr.ndim != sum(map(str.isalpha, shape)):
        raise ConformalError(f"{name} must be finite, of shape {shape}, got shape {arr.shape}")
    if not np.isfinite(arr).all():
        at = np.argwhere(~np.isfinite(arr))[0]
        raise ConformalError(f"{name} must be finite, of shape {shape}, found {arr[tuple(at)]} at {at.tolist()}")
    return arr


def as_scores(values: Any, name: str = "scores") -> RealArray:
    """Scores in float32 or float64: anything but NaN, infinities included."""
    arr = as_reals(values, name)
    if arr.size and np.isnan(arr.min()):  # without an array of flags, which would be a quarter as large
        raise ConformalError(f"{name} must not hold NaN; a sample that cannot be scored should score +inf")
    return arr


def as_flags(values: Any, name: str, ndim: int) -> BoolArray:
    """Booleans with `ndim` axes, not copied if they are an array already."""
    arr = values if type(values) is np.ndarray else as_array(values, name)
    if arr.dtype != np.bool_ or arr.ndim != ndim:
        raise ConformalError(f"{name} must be boolean, with {ndim} axes, got {arr.dtype} {arr.shape}")
    return arr


def as_targets(y: npt.ArrayLike, n_targets: int | None = None) -> FloatArray:
    """`y` as a finite (n, d) float64 array; a vector is one target."""
    given = as_doubles(y, "y")
    arr = given[:, None] if given.ndim == 1 else given
    if arr.ndim != 2 or arr.shape[1] == 0:
        raise ConformalError(f"y must have shape (n,) or (n, d) with d >= 1, got {given.shape}")
    if n_targets is not None and arr.shape[1] != n_targets:
        raise ConformalError(f"y has {counted(arr.shape[1], 'target')}, shape {given.shape}; expected {n_targets}")
    if not np.isfinite(arr).all():
        row, col = np.argwhere(~np.isfinite(arr))[0]
        raise ConformalError(f"y must be finite, found {arr[row, col]} in row {row}, target {col}")
    return arr


def as_table(
    proba: Probabilities, n_bins: Sequence[int], name: str = "proba", check: bool = True
) -> tuple[list[RealArray], RealArray | None]:
    """One checked ``(n, K_j)`` array per target, and all as one ``(n, d, K)`` array if they came as one; not copied.

    `proba` is (n, d, K), (n, K) for one target, or a list of d arrays (n, K_j) for `n_bins` = [K_1, ..., K_d]; nested
    lists that can be read as either are (n, d, K). With ``check=False`` only the shapes are checked.
    """
    d = len(n_bins)
    whole: RealArray | None = None
    if isinstance(proba, (list, tuple)) and _one_per_target(proba, n_bins):
        parts = [as_reals(part, f"{name} of target {j}") for j, part in enumerate(proba)]
    else:
        whole = as_reals(proba, name)
        if whole.ndim == 2 and d == 1:
            whole = whole[:, None, :]
        if whole.ndim != 3 or whole.shape[1] != d:
            raise ConformalError(f"{name} must have shape (n, {d}, K) or be a list of {d} arrays, got {whole.shape}")
        parts = [whole[:, j] for j in range(d)]
    n = parts[0].shape[0] if parts[0].ndim else 0
    for j, (part, k) in enumerate(zip(parts, n_bins, strict=True)):
        if part.shape != (n, k):
            raise ConformalError(f"{name} of target {j} has shape {part.shape}, expected ({n}, {k}): {k} bins")
        if check:
            check_rows(part, f"{name} of target {j}")
    return parts, whole


def _one_per_target(proba: Sequence[Any], n_bins: Sequence[int]) -> bool:
    """Whether a list holds one (n, K_j) array per target, rather than one (d, K) table per sample."""
    d = len(n_bins)
    if len(proba) != d:
        return False
    if not all(isinstance(part, (list, tuple)) for part in proba):
        return all(getattr(part, "ndim", 2) == 2 for part in proba)
    if not all(part and _is_row(part[0]) for part in proba):
        return False
    # d tables of d rows, all with as many bins: what NumPy makes of them, (n, d, K)
    return len(set(n_bins)) > 1 or any(len(part) != d for part in proba)


def _is_row(row: Any) -> bool:
    if isinstance(row, (list, tuple)):
        return not (row and isinstance(row[0], (list, tuple)))
    return getattr(row, "ndim", 0) == 1


def check_rows(part: npt.NDArray[Any], name: str) -> None:
    """Check that rows (the last axis) are probabilities, block by block so that memory is read once."""
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
    if not (off <= _ROW_SUM_TOLERANCE).all():
        row = int(np.argmax(~(off <= _ROW_SUM_TOLERANCE)))
        total = sums[row].flat[np.abs(sums[row] - 1).argmax()]
        raise ConformalError(f"{name} must sum to 1 in every row; row {first_row + row} sums to {total:.6g}")


def blocks(n: int) -> Iterator[slice]:
    """Slices of at most ``_BLOCK_ROWS`` rows that cover n rows."""
    return (slice(start, min(start + _BLOCK_ROWS, n)) for start in range(0, n, _BLOCK_ROWS))


def for_blocks(n: int, work: Callable[[slice], None]) -> None:
    """Call `work` for every block of rows, in threads if there are many; blocks must write to disjoint rows."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if n < _ROWS_WORTH_THREADS or cores == 1:
        for rows in blocks(n):
            work(rows)
        return
    with ThreadPoolExecutor(cores) as pool:
        for _ in pool.map(work, blocks(n)):
            pass
