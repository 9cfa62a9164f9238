"""Arguments as they enter the package, in one form each: rates, numbers, names, arrays, probabilities, labels.

Public entry points call these functions once; what is behind them trusts its input.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from datetime import date
from decimal import Decimal
from fractions import Fraction
from numbers import Rational, Real
from typing import Any, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, RealArray
from conformodal.core.words import counted

from .errors import ConformodalError

Alpha: TypeAlias = float | str | Decimal | Fraction
Probabilities: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]

# float16 softmax rows of a few hundred classes sum to one within about this
_ROW_SUM_TOLERANCE = 5e-3
_BLOCK_ROWS = 4096
# beyond this power of ten a decimal is not a rate, and would take long to read
_MAX_EXPONENT = 400


def brief(value: object) -> str:
    """`value` as errors show it, on one line."""
    return shortened(" ".join(repr(value).split()), 80)


def shortened(text: str, most: int = 300) -> str:
    """`text` without its middle if it is longer than `most`."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def reason(exc: Exception) -> str:
    """The message of an exception, on one line."""
    return shortened(" ".join(str(exc).split()))


def as_alpha(alpha: Alpha) -> Fraction:
    """A miscoverage rate as the decimal it is written as: ``0.1`` is one tenth, not 0.1000000000000000055."""
    try:
        exponent = str(alpha).lower().partition("e")[2]
        if isinstance(alpha, bool) or (exponent and abs(int(exponent)) > _MAX_EXPONENT):
            raise ValueError
        rate = Fraction(alpha if isinstance(alpha, Rational) else str(alpha))
    except (ValueError, ZeroDivisionError):
        raise ConformodalError(f"alpha must be a number strictly between 0 and 1, got {brief(alpha)}") from None
    if not 0 < rate < 1:
        percent = float(rate) / 100  # a miscoverage, or, if it is more than half, a coverage
        hint = f"; did you mean {min(percent, 1 - percent):g}?" if 1 < rate < 100 else ""
        text = brief(str(alpha)).strip("'")
        raise ConformodalError(f"alpha must lie strictly between 0 and 1 (a miscoverage rate), got {text}{hint}")
    return rate


def as_count(value: Any, name: str, least: int = 0, most: int | None = None) -> int:
    """An integer of at least `least` and at most `most`; booleans and floats are refused."""
    end = "" if most is None else f" and at most {most}"
    try:
        number = least - 1 if isinstance(value, (bool, np.bool_)) else operator.index(value)
    except TypeError:
        number = least - 1
    if number < least or (most is not None and number > most):
        raise ConformodalError(f"{name} must be a whole number, at least {least}{end}, got {brief(value)}")
    return number


def as_number(value: Any, name: str, expected: str, holds: Callable[[float], bool]) -> float:
    """A real number for which `holds`; `expected` describes it in messages."""
    if not isinstance(value, Real) or isinstance(value, bool) or not holds(float(value)):
        raise ConformodalError(f"{name} must be {expected}, got {brief(value)}")
    return float(value)


def as_choice(value: Any, options: Any, name: str) -> None:
    """Check a name against a ``Literal``."""
    if not isinstance(value, str) or value not in get_args(options):
        raise ConformodalError(f"{name} must be one of {list(get_args(options))}, got {brief(value)}")


def as_random(random_state: Any) -> np.random.RandomState:
    """The random numbers of a seed, a ``RandomState`` or None, as in scikit-learn."""
    from sklearn.utils import check_random_state  # noqa: PLC0415 - half a second to import

    try:
        generator: np.random.RandomState = check_random_state(random_state)
    except ValueError as exc:
        raise ConformodalError(f"random_state: {reason(exc)}") from None
    return generator


def as_reals(values: Any, name: str) -> RealArray:
    """Any array-like of real numbers as a float32 or float64 array, not copied if it is one.

    Text, dates, complex numbers, sparse matrices and masked entries are refused.
    """
    if type(values) is np.ndarray and values.dtype.char in "fd" and values.dtype.isnative:
        return values
    if np.ma.is_masked(values):
        raise ConformodalError(f"{name} must not hold masked entries")
    if issparse(values):
        raise ConformodalError(f"{name} must be a dense array, got a sparse one: call its toarray() first")
    try:
        arr = np.asarray(values)
        if arr.dtype.kind not in "biufO" or not all(
            isinstance(v, (Real, Decimal)) for v in arr.flat if arr.dtype == object
        ):
            problem = "Complex data not supported" if arr.dtype.kind == "c" else "expected real numbers"
            raise TypeError(f"{problem}, got {arr.dtype}")
        with np.errstate(over="ignore"):
            return arr.astype(np.float32 if arr.dtype.char in "ef" else np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError) as exc:
        raise ConformodalError(f"{name} must be numeric, of real numbers: {reason(exc)}") from None


def as_doubles(values: Any, name: str) -> FloatArray:
    """:func:`as_reals` in float64."""
    return as_reals(values, name).astype(np.float64, copy=False)


def as_finite(values: Any, name: str, shape: str) -> FloatArray:
    """Finite numbers in float64, with as many axes as `shape`, such as ``"(n, k)"``, has letters."""
    arr = as_doubles(values, name)
    if arr.ndim != sum(map(str.isalpha, shape)):
        raise ConformodalError(f"{name} must be finite, of shape {shape}, got shape {arr.shape}")
    if not np.isfinite(arr).all():
        at = np.argwhere(~np.isfinite(arr))[0]
        raise ConformodalError(f"{name} must be finite, of shape {shape}, got {arr[tuple(at)]} at {at.tolist()}")
    return arr


def as_scores(values: Any, name: str = "scores") -> RealArray:
    """Scores in float32 or float64: anything but NaN, infinities included."""
    arr = as_reals(values, name)
    if arr.size and np.isnan(arr.min()):  # without an array of flags, which would be a quarter as large
        raise ConformodalError(f"{name} must not hold NaN; a sample that cannot be scored should score +inf")
    return arr


def as_flags(values: Any, name: str, ndim: int) -> BoolArray:
    """Booleans with `ndim` axes, not copied if they are an array already."""
    arr = np.asarray(values)
    if arr.dtype != np.bool_ or arr.ndim != ndim or np.ma.is_masked(values):
        raise ConformodalError(f"{name} must be boolean, with {counted(ndim, 'axis', 'axes')}, got {brief(values)}")
    return arr


def as_targets(y: npt.ArrayLike, n_targets: int | None = None) -> FloatArray:
    """`y` as a finite (n, d) float64 array; a vector is one target."""
    given = as_doubles(y, "y")
    arr = given[:, None] if given.ndim == 1 else given
    if arr.ndim != 2 or arr.shape[1] == 0:
        raise ConformodalError(f"y must have shape (n,) or (n, d) with d >= 1, got {given.shape}")
    if n_targets is not None and arr.shape[1] != n_targets:
        raise ConformodalError(f"y has {counted(arr.shape[1], 'target')}, shape {given.shape}; expected {n_targets}")
    if not np.isfinite(arr).all():
        row, col = np.argwhere(~np.isfinite(arr))[0]
        raise ConformodalError(f"y must be finite, got {arr[row, col]} in row {row}, target {col}")
    return arr


def column_names(table: Any, name: str, expected: list[str] | None) -> list[str]:
    """Names of a frame's columns, none of an array's; those that were `expected`, in another order, are refused."""
    names = list(map(str, getattr(table, "column_names", getattr(table, "columns", ()))))
    if expected and names != expected and sorted(names) == sorted(expected):
        order = f"got {brief(names)}, expected {brief(expected)}"
        raise ConformodalError(f"{name} has its columns in another order than in training: {order}")
    return names


class BinProbabilities(list[RealArray]):
    """Probabilities that were checked: one (n, K_j) array per target."""


def as_probabilities(proba: Probabilities, n_bins: Sequence[int], name: str = "proba") -> BinProbabilities:
    """Probabilities of the bins, one (n, K_j) array per target; what was checked before comes back as it is.

    `proba` is (n, d, K), (n, K) for one target, or a list of d arrays (n, K_j) for `n_bins` = [K_1, ..., K_d]; nested
    lists that can be read as either are (n, d, K).
    """
    if isinstance(proba, BinProbabilities) and [part.shape[1] for part in proba] == list(n_bins):
        return proba
    d = len(n_bins)
    if isinstance(proba, (list, tuple)) and len(proba) == d and _one_per_target(proba, n_bins):
        parts = [as_reals(part, f"{name} of target {j}") for j, part in enumerate(proba)]
    else:
        whole = as_reals(proba, name)
        whole = whole[:, None, :] if whole.ndim == 2 and d == 1 else whole
        if whole.ndim != 3 or whole.shape[1] != d:
            raise ConformodalError(f"{name} must have shape (n, {d}, K) or be a list of {d} arrays, got {whole.shape}")
        parts = [whole[:, j] for j in range(d)]
    for j, (part, k) in enumerate(zip(parts, n_bins, strict=True)):
        if part.shape != (len(parts[0]), k):
            expected = f"({len(parts[0])}, {k}): {k} bins"
            raise ConformodalError(f"{name} of target {j} has shape {part.shape}, expected {expected}")
        _check_distributions(part, f"{name} of target {j}")
    return BinProbabilities(parts)


def _one_per_target(proba: Sequence[Any], n_bins: Sequence[int]) -> bool:
    """Whether a list of d entries holds one (n, K_j) array per target, rather than one (d, K) table per sample."""
    if any(np.ndim(as_reals(part, "proba")) != 2 for part in proba):
        return False
    nested = all(isinstance(part, (list, tuple)) for part in proba)
    # d lists of d rows, all with as many bins: what NumPy makes of them, (n, d, K)
    return not nested or len(set(n_bins)) > 1 or any(len(part) != len(n_bins) for part in proba)


def _check_distributions(proba: RealArray, name: str) -> None:
    """Check that rows (n, K) are probabilities."""
    if proba.size == 0:
        return
    low = proba.min()
    if not low >= 0:  # also catches NaN
        what = "NaN" if np.isnan(low) else f"negative values (smallest {low:g})"
        raise ConformodalError(f"{name}, shape {proba.shape}, holds {what}; expected probabilities")
    sums = np.einsum("nk->n", proba)  # reads memory at full speed where sum(axis=-1) does not
    valid = np.abs(sums - 1) <= _ROW_SUM_TOLERANCE  # not of infinities
    if not valid.all():
        row = int(np.argmin(valid))
        raise ConformodalError(f"{name} must sum to 1 in every row; row {row} sums to {sums[row]:.6g}")


def blocks(n: int) -> Iterator[slice]:
    """Slices of at most 4096 rows that cover n rows."""
    return (slice(start, min(start + _BLOCK_ROWS, n)) for start in range(0, n, _BLOCK_ROWS))


def is_missing(value: Any) -> bool:
    """Whether a value stands for none: None, NaN, NaT, ``pandas.NA``."""
    return value is None or (str(value) in ("nan", "NaT", "<NA>", "sNaN", "NaN") and not isinstance(value, str))


def as_labels(labels: npt.ArrayLike, n: int, name: str = "groups") -> AnyArray:
    """Labels (n,), one per sample: text, numbers or dates, in any container; missing ones are refused."""
    if np.ma.is_masked(labels):
        raise ConformodalError(f"{name} must not hold masked entries")
    try:
        arr = np.asarray(labels, dtype=object if isinstance(labels, (list, tuple)) else None)
    except ValueError as exc:
        raise ConformodalError(f"{name} must be labels: {reason(exc)}") from None
    if arr.shape != (n,):
        raise ConformodalError(f"{name} must have one label per sample, shape ({n},), got {arr.shape}")
    values = (arr.astype("M8[us]") if arr.dtype.kind == "M" else arr).tolist()
    for row, value in enumerate(values):
        if is_missing(value):
            raise ConformodalError(f"{name} must not hold a missing label, got {brief(value)} in row {row}")
    for kind, dtype in ((str, np.str_), (Real, None), ((date, np.datetime64), "M8[us]")):
        if all(isinstance(value, kind) for value in values):
            return np.array(values, dtype=dtype)
    raise ConformodalError(f"{name} must be text, numbers or dates, all of one kind, got {brief(values[:5])}")


def factorise(labels: AnyArray) -> tuple[list[Any], IntArray]:
    """The distinct labels, sorted, and the index of each sample's label (n,)."""
    distinct, codes = np.unique(labels, return_inverse=True)
    return distinct.tolist(), codes.astype(np.int64)
