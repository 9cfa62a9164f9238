"""Checks of arguments: arrays and single values come out in one form, or an error names what is wrong.

Every array passes :func:`as_reals`, which returns real numbers of native byte order, float32 or float64. Strings, dates
and masked entries, which NumPy and scikit-learn would convert, are refused.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from numbers import Rational, Real
from typing import Any, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, RealArray
from conformodal.core.words import counted

from .errors import ConformalError

Alpha: TypeAlias = float | str | Decimal | Fraction
Probabilities: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]

# float16 softmax rows of a few hundred classes sum to one within about this
_ROW_SUM_TOLERANCE = 5e-3
_BLOCK_ROWS = 4096
# powers of ten beyond which a decimal is not a rate, and would take long to read
_MOST_DIGITS = 400
_LONGEST_REPR = 80


def brief(value: object) -> str:
    """`value` as errors show it, on one line."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever a foreign class raises
        text = f"<{type(value).__name__}>"
    return shortened(text, _LONGEST_REPR)


def shortened(text: str, most: int = 300) -> str:
    """`text` without its middle if it is longer than `most`."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def reason(exc: Exception) -> str:
    """What an exception says, on one line."""
    return shortened(" ".join(str(exc).split()))


def as_alpha(alpha: Alpha) -> Fraction:
    """A miscoverage rate as the decimal it is written as: ``0.1`` is one tenth, not 0.1000000000000000055."""
    try:
        if isinstance(alpha, bool):
            raise TypeError
        power = str(alpha).lower().partition("e")[2]
        if power and abs(int(power)) > _MOST_DIGITS:
            raise ValueError
        value = Fraction(alpha if isinstance(alpha, Rational) else str(alpha))
    except (ValueError, TypeError, OverflowError, ZeroDivisionError):
        raise ConformalError(f"alpha must be a number strictly between 0 and 1, got {brief(alpha)}") from None
    if not 0 < value < 1:
        percent = float(value) / 100  # a miscoverage, or, if it is more than half, a coverage
        hint = f"; did you mean {min(percent, 1 - percent):g}?" if 1 < value < 100 else ""
        found = brief(str(alpha)).strip("'")
        raise ConformalError(f"alpha must lie strictly between 0 and 1 (a miscoverage rate), got {found}{hint}")
    return value


def as_count(value: Any, name: str, least: int = 0, most: int | None = None) -> int:
    """An integer of at least `least` and at most `most`; booleans and floats are refused."""
    try:
        if isinstance(value, (bool, np.bool_)):
            raise TypeError
        number = operator.index(value)
    except Exception:  # whatever a foreign class raises
        raise ConformalError(f"{name} must be a whole number, at least {least}, got {brief(value)}") from None
    if number < least or (most is not None and number > most):
        end = "" if most is None else f" and at most {most}"
        raise ConformalError(f"{name} must be a whole number, at least {least}{end}, got {number}")
    return number


def as_number(value: Any, name: str, expected: str, holds: Callable[[float], bool]) -> float:
    """A real number for which `holds`; `expected` describes it in messages."""
    if isinstance(value, np.ndarray) and value.ndim == 0 and not isinstance(value, np.ma.MaskedArray):
        value = value[()]
    number = float("nan")
    if isinstance(value, (Real, Decimal)) and not isinstance(value, bool):
        with suppress(OverflowError, ValueError):
            number = float(value)
    if not holds(number):
        raise ConformalError(f"{name} must be {expected}, got {brief(value)}")
    return number


def as_choice(value: Any, options: Any, name: str) -> None:
    """Check a name against a ``Literal``."""
    if not isinstance(value, str) or value not in get_args(options):
        raise ConformalError(f"{name} must be one of {list(get_args(options))}, got {brief(value)}")


def as_random(random_state: Any) -> np.random.RandomState:
    """The random numbers of a seed, a ``RandomState`` or None, as in scikit-learn."""
    from sklearn.utils import check_random_state  # noqa: PLC0415 - a second to import

    try:
        found: np.random.RandomState = check_random_state(random_state)
        return found
    except (ValueError, TypeError):
        raise ConformalError(f"random_state must be a seed, a RandomState or None, got {brief(random_state)}") from None


def as_array(values: Any, name: str) -> AnyArray:
    """Any array-like as an array of any dtype; masked entries, which NumPy would drop, are refused."""
    if issparse(values):
        raise ConformalError(f"{name} must be a dense array, got a sparse one: call its toarray() first")
    try:
        if isinstance(values, (list, tuple, np.ma.MaskedArray)):
            masked = np.argwhere(np.ma.getmaskarray(np.ma.asanyarray(values)))
            if masked.size:
                raise ConformalError(f"{name} must not hold masked entries, found one at position {masked[0].tolist()}")
        if callable(getattr(values, "combine_chunks", None)):  # of Arrow, whose chunks of categories fill gaps with one
            values = values.combine_chunks()
        if callable(getattr(values, "detach", None)):  # a tensor of torch, with a gradient or on a device
            values = values.detach().cpu()
        return np.asarray(values)
    except (ConformalError, MemoryError):
        raise
    except Exception as exc:  # whatever a foreign class raises
        raise ConformalError(f"{name} cannot be read as an array, got {type(values).__name__}: {reason(exc)}") from None


def as_reals(values: Any, name: str) -> RealArray:
    """Any array-like of real numbers as a float32 or float64 array of native byte order, not copied if it is one.

    float16 becomes float32; integers, booleans, ``longdouble`` and objects become float64.
    """
    if type(values) is np.ndarray and values.dtype.char in "fd" and values.dtype.isnative:
        return values
    arr = as_array(values, name)
    if arr.dtype.kind == "O":
        for at, value in np.ndenumerate(arr):
            if not isinstance(value, (Real, Decimal, np.bool_)):
                place = f" at position {list(at)}" if at else ""
                raise ConformalError(f"{name} must be numeric, of real numbers, found {brief(value)}{place}")
    elif arr.dtype.kind not in "biuf":
        raise ConformalError(f"{name} must be numeric, of real numbers, got dtype {arr.dtype}")
    try:
        with np.errstate(over="ignore"):
            return arr.astype(np.float32 if arr.dtype.char in "ef" else np.float64, copy=False)
    except (OverflowError, ValueError) as exc:
        raise ConformalError(f"{name} holds a number that float64 cannot hold: {exc}") from None


def as_doubles(values: Any, name: str) -> FloatArray:
    """:func:`as_reals` in float64."""
    return as_reals(values, name).astype(np.float64, copy=False)


def column_names(table: Any, name: str, learnt: list[str] | None) -> list[str]:
    """Names of a frame's columns, none of an array's; those that were `learnt`, in another order, are refused."""
    found = list(map(str, getattr(table, "column_names", getattr(table, "columns", ()))))
    if learnt and found != learnt and sorted(found) == sorted(learnt):
        order = f"got {brief(found)}, expected {brief(learnt)}"
        raise ConformalError(f"{name} has its columns in another order than in training: {order}")
    return found


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
        for rows in blocks(n if check else 0):  # block by block, so that memory is read once
            check_block(part[rows], f"{name} of target {j}", rows.start)
    return parts, whole


def _one_per_target(proba: Sequence[Any], n_bins: Sequence[int]) -> bool:
    """Whether a list holds one (n, K_j) array per target, rather than one (d, K) table per sample."""
    d, lists = len(n_bins), all(isinstance(part, (list, tuple)) for part in proba)
    if len(proba) != d or any(as_array(part, "proba").ndim != 2 for part in proba):
        return False
    # d lists of d rows, all with as many bins: what NumPy makes of them, (n, d, K)
    return not lists or len(set(n_bins)) > 1 or any(len(part) != d for part in proba)


def check_block(block: AnyArray, name: str, first_row: int) -> None:
    """Check that rows (the last axis) are probabilities; the first is row `first_row` of the whole."""
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
