"""Arguments as they enter the package, in one form each: rates, numbers, names, arrays, probabilities, labels.

Public entry points call these functions once; what is behind them trusts its input.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date
from decimal import Decimal
from fractions import Fraction
from numbers import Rational, Real
from typing import Any, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

Alpha: TypeAlias = float | str | Decimal | Fraction
Probabilities: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]

SHARE = Range(0, 1, "()")
# float16 softmax rows of a few hundred classes sum to one within about this
_ROW_SUM_TOLERANCE = 5e-3
_BLOCK_ROWS = 4096


class ConformodalTypeError(ConformodalError, TypeError):
    """For sparse matrices and objects, which scikit-learn expects a ``TypeError`` for."""


def not_calibrated(message: str) -> ConformodalError:
    """A ``NotCalibratedError``, to be raised."""
    from .errors import NotCalibratedError  # noqa: PLC0415 - scikit-learn takes half a second to import

    return NotCalibratedError(message)


def brief(value: object, most: int = 80) -> str:
    """A value, or the message of an exception, on one line without its middle if it is long."""
    text = " ".join((str(value) if isinstance(value, Exception) else repr(value)).split())
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def as_alpha(alpha: Alpha) -> Fraction:
    """A miscoverage rate as the decimal it is written as: ``0.1`` is one tenth, not 0.1000000000000000055."""
    try:
        rate = Fraction(alpha if isinstance(alpha, Rational) else str(alpha))
    except (ValueError, ZeroDivisionError):
        raise ConformodalError(f"alpha must be a number strictly between 0 and 1, got {brief(alpha)}") from None
    if not 0 < rate < 1:
        percent = float(rate) / 100  # a miscoverage, or, if it is more than half, a coverage
        hint = f"; did you mean {min(percent, 1 - percent):g}?" if 1 < rate < 100 else ""
        raise ConformodalError(f"alpha must lie strictly between 0 and 1 (a miscoverage rate), got {alpha}{hint}")
    return rate


def doubt_alpha(alpha: Alpha) -> str:
    """A question about a rate from one half on, which is likely to be meant as a coverage; or nothing."""
    rate = as_alpha(alpha)
    if rate < Fraction(1, 2):
        return ""
    held, asked = f"alpha = {alpha} gives sets that hold {float(1 - rate):.0%} of all samples", f"{float(rate):.0%}"
    return f"{held}; did you mean {float(1 - rate):g}, for {asked}?"


def check_number(value: Any, name: str, allowed: Range) -> Any:
    """A number, if it is one of those allowed."""
    if not allowed.holds(value):
        raise ConformodalError(f"{name} must be {allowed}, got {brief(value)}")
    return value


def as_choice(value: Any, options: Any, name: str) -> None:
    """Check a name against a ``Literal``."""
    if not isinstance(value, str) or value not in get_args(options):
        raise ConformodalError(f"{name} must be one of {list(get_args(options))}, got {brief(value)}")


def as_reals(values: Any, name: str) -> RealArray:
    """Any array-like of real numbers as a float32 or float64 array, not copied if it is one."""
    if type(values) is np.ndarray and values.dtype.char in "fd" and values.dtype.isnative:
        return values
    if np.ma.is_masked(values):
        raise ConformodalError(f"{name} must not hold masked entries")
    if hasattr(values, "toarray"):
        raise ConformodalError(f"{name} must be a dense array, got a sparse one: call its toarray() first")
    try:
        arr = np.asarray(values)
        if arr.dtype.kind not in "biufO":
            raise TypeError("Complex data not supported" if arr.dtype.kind == "c" else f"got {arr.dtype}")
        return arr.astype(np.float32 if arr.dtype.char in "ef" else np.float64, copy=False)
    except (TypeError, ValueError, OverflowError) as exc:
        raise ConformodalError(f"{name} must be numeric, of real numbers: {brief(exc)}") from None


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
        raise ConformodalError(f"{name} must be finite, of shape {shape}, got {arr[tuple(at)]} in row {at[0]}")
    return arr


def as_scores(values: Any, name: str = "scores") -> RealArray:
    """Scores in float32 or float64: anything but NaN, infinities included."""
    arr = as_reals(values, name)
    if arr.size and np.isnan(arr.min()):  # without an array of flags, which would be a quarter as large
        raise ConformodalError(f"{name} must not hold NaN; a sample that cannot be scored should score +inf")
    return arr


def as_targets(y: npt.ArrayLike, n_targets: int | None = None) -> FloatArray:
    """`y` as a finite (n, d) float64 array; a vector is one target."""
    given = as_doubles(y, "y")
    arr = as_finite(given[:, None] if given.ndim == 1 else given, "y", "(n, d)")
    if arr.shape[1] == 0 or n_targets not in (None, arr.shape[1]):
        raise ConformodalError(f"y has shape {given.shape}, expected {n_targets or 'at least 1'} per row")
    return arr


def column_names(table: Any, name: str, expected: list[str] | None) -> list[str]:
    """Names of a frame's columns, none of an array's; those that were `expected`, in another order, are refused."""
    names = list(map(str, getattr(table, "columns", ())))
    if expected and names != expected and sorted(names) == sorted(expected):
        order = f"got {brief(names)}, expected {brief(expected)}"
        raise ConformodalError(f"{name} has its columns in another order than in training: {order}")
    return names


class BinProbabilities(list[RealArray]):
    """Probabilities that were checked: one (n, K_j) array per target."""


def as_probabilities(proba: Probabilities, n_bins: Sequence[int], name: str = "proba") -> BinProbabilities:
    """Probabilities of the bins, one (n, K_j) array per target; what was checked before comes back as it is.

    `proba` is (n, d, K), (n, K) for one target, or a list of d arrays (n, K_j) for `n_bins` = [K_1, ..., K_d].
    """
    if isinstance(proba, BinProbabilities) and [part.shape[1] for part in proba] == list(n_bins):
        return proba
    d = len(n_bins)
    if isinstance(proba, (list, tuple)) and len(proba) == d and all(hasattr(part, "shape") for part in proba):
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
        sums = np.einsum("nk->n", part)  # reads memory at full speed where sum(axis=-1) does not
        wrong = ~(np.abs(sums - 1) <= _ROW_SUM_TOLERANCE)  # also of infinities and NaN
        if wrong.any():
            row = int(np.argmax(wrong))
            raise ConformodalError(f"{name} of target {j} must sum to 1 in every row, row {row} to {sums[row]:.6g}")
        if part.min(initial=0) < 0:
            raise ConformodalError(f"{name} of target {j} holds negative values, {part.min():g}; is it a softmax?")
    return BinProbabilities(parts)


def blocks(n: int) -> Iterator[slice]:
    """Slices of at most 4096 rows that cover n rows."""
    return (slice(start, min(start + _BLOCK_ROWS, n)) for start in range(0, n, _BLOCK_ROWS))


def is_missing(value: Any) -> bool:
    """Whether a value stands for none: None, NaN, NaT, ``pandas.NA``."""
    return value is None or (str(value) in ("nan", "NaT", "<NA>", "sNaN", "NaN") and not isinstance(value, str))


def as_labels(labels: npt.ArrayLike, n: int, name: str = "groups") -> AnyArray:
    """Labels (n,), one per sample, in any container: text, numbers or dates; missing ones are refused."""
    arr = np.asarray(labels, dtype=object if isinstance(labels, (list, tuple)) else None)
    if arr.shape != (n,) or np.ma.is_masked(labels):
        raise ConformodalError(f"{name} must have one label per sample, shape ({n},), got {arr.shape}")
    values = (arr.astype("M8[us]") if arr.dtype.kind == "M" else arr).tolist()
    for kind, dtype in ((str, np.str_), (Real, None), ((date, np.datetime64), "M8[us]")):
        if all(isinstance(value, kind) and not is_missing(value) for value in values):
            return np.array(values, dtype=dtype)
    raise ConformodalError(f"{name} must be text, numbers or dates, all of one kind, none missing; got {brief(values)}")


def as_known_labels(labels: npt.ArrayLike, n: int, name: str = "groups") -> tuple[AnyArray, BoolArray]:
    """:func:`as_labels` of new samples, of which some may have none; and whether each has none (n,)."""
    arr = np.asarray(labels, dtype=object if isinstance(labels, (list, tuple)) else None)
    if arr.shape != (n,) or arr.dtype.kind not in "OfM":
        return as_labels(labels, n, name), np.zeros(n, dtype=np.bool_)
    gaps = np.array([is_missing(value) for value in arr.tolist()], dtype=np.bool_)
    known = as_labels(labels if not gaps.any() else arr[~gaps], int((~gaps).sum()), name)
    values = np.zeros(n, dtype=known.dtype)
    values[~gaps] = known
    return values, gaps


def factorise(labels: AnyArray) -> tuple[list[Any], IntArray]:
    """The distinct labels, sorted, and the index of each sample's label (n,)."""
    distinct, codes = np.unique(labels, return_inverse=True)
    return distinct.tolist(), codes.astype(np.int64)
