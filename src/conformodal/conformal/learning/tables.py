"""Tables of any kind (arrays; frames of pandas, polars and Arrow) by rows, and as columns of finite numbers."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from datetime import date, datetime, timedelta
from decimal import Decimal
from numbers import Real
from typing import Any, Self

import numpy as np
from scipy.sparse import issparse

from conformodal.conformal.checks import as_array, as_doubles, brief, column_names
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.grouping import is_missing
from conformodal.core.arrays import AnyArray, FloatArray
from conformodal.core.words import counted

# labels of a column of text that get a column of their own, the most frequent ones, each in at least two rows
_MOST_LABELS, _LEAST_ROWS = 20, 2
_DAY = np.timedelta64(1, "D")


def is_frame(X: Any) -> bool:
    """Whether `X` is a table with named columns: of pandas, polars or Arrow."""
    return hasattr(X, "columns") and hasattr(X, "shape")


def names_of(X: Any) -> list[Hashable]:
    """The names of a frame's columns."""
    return list(X.column_names if hasattr(X, "column_names") else X.columns)


def column_of(X: Any, j: int) -> Any:
    """Column `j` of a frame, as its library has it."""
    if hasattr(X, "iloc"):
        return X.iloc[:, j]
    return X.column(j) if hasattr(X, "column_names") else X[:, j]


def rows_of(X: Any, rows: Any) -> Any:
    """Some rows of a table, by a slice, a mask or positions: the same kind of table."""
    if not is_frame(X):
        return X[rows]
    positions = np.arange(X.shape[0])[rows]
    if hasattr(X, "iloc"):
        return X.iloc[positions]
    return X.take(positions) if hasattr(X, "column_names") else X[positions]


def as_column(column: Any, name: object, text: bool = False) -> AnyArray:
    """A column as float64, missing NaN and dates in days; or, of text and categories, as text, missing ``""``.

    With `text`, objects of any kind and a column without any value are text too.
    """
    arr = as_array(column, f"column {name}")
    nested = arr.ndim != 1 or arr.dtype.kind in "cV"
    for value in arr if nested or arr.dtype.kind == "O" else ():
        if nested or (not isinstance(value, (str, bytes, tuple)) and np.iterable(value)):
            raise ConformalError(f"column {name} must hold numbers, dates or text, found {brief(value)}")
    kind = str(getattr(column, "dtype", getattr(column, "type", ""))).lower()
    labels = kind.startswith(("categor", "enum", "dictionary")) or (text and arr.dtype.kind == "O")
    if arr.dtype.kind == "O" and not labels:
        known = [value for value in arr if not is_missing(value)]
        if all(isinstance(value, (Real, Decimal, np.bool_)) for value in known):
            arr = np.array([np.nan if is_missing(value) else float(value) for value in arr])
        elif all(isinstance(value, date) for value in known):
            times = [None if is_missing(v) else v.replace(tzinfo=None) if isinstance(v, datetime) else v for v in arr]
            arr = np.array(times, dtype="M8[us]")
    if arr.dtype.kind in "mM":
        arr = np.where(np.isnat(arr), np.nan, (arr - arr.dtype.type(0, "D") if arr.dtype.kind == "M" else arr) / _DAY)
    if arr.dtype.kind in "biuf" and not labels:
        numbers = arr.astype(np.float64)
        if np.isinf(numbers).any():
            row = int(np.isinf(numbers).argmax())
            raise ConformalError(f"column {name} must be finite or missing, found {numbers[row]} in row {row}")
        return np.full(numbers.shape, "") if text and np.isnan(numbers).all() else numbers
    return np.array([_label(value) for value in arr], dtype=np.str_)


def _label(value: Any) -> str:
    """A value as text; gaps turn the whole numbers of a category into floats, which are the same labels."""
    if is_missing(value):
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)


def named_targets(y: Any, learnt: list[str] | None) -> tuple[Any, list[str] | None]:
    """Values to predict as an array, of a frame or series as float64, and their names; none may be missing."""
    names = None
    if is_frame(y):
        names = column_names(y, "y", learnt)
        columns = [_target(column_of(y, j), name) for j, name in enumerate(names)]
        values: AnyArray = np.column_stack([np.empty((y.shape[0], 0)), *columns])
    elif hasattr(y, "to_frame"):  # a series
        names, values = [str(y.name)] if y.name else None, _target(y, y.name)
    else:
        values = as_array(y, "y")
        values = _target(values, None) if values.dtype.kind == "O" and values.ndim == 1 else values
    if values.dtype.kind == "f" and values.ndim and np.isnan(values).any():
        gaps = np.flatnonzero(np.isnan(values.reshape(len(values), -1)).any(axis=1))
        first = ", ".join(map(str, gaps[:10].tolist())) + (", ..." if gaps.size > 10 else "")
        raise ConformalError(f"y has no value in {counted(gaps.size, 'row')} ({first}): leave them out")
    return values if values.ndim else y, names  # without an axis it is None or a single value


def _target(column: Any, name: object) -> FloatArray:
    """A column of values to predict as float64, missing NaN; dates, which regions could not hold, are refused."""
    what = f"y, {name}," if name else "y"
    arr = as_array(column, what)
    if arr.dtype.kind in "mM" or (arr.dtype.kind == "O" and any(isinstance(v, (date, timedelta)) for v in arr)):
        raise ConformalError(f"{what} must be numeric, found dates or times: give days since a date, say")
    return as_doubles(as_column(arr, name or "y"), what)


def columns_of(X: Any, text: Collection[int] = ()) -> list[tuple[Hashable, AnyArray]]:
    """Names and values of the columns of a table, see :func:`as_column`; an array has numbers only."""
    if is_frame(X):
        return [(name, as_column(column_of(X, j), name, j in text)) for j, name in enumerate(names_of(X))]
    arr = as_doubles(X, "X")
    if arr.ndim != 2 or np.isinf(arr).any():
        raise ConformalError(f"X must be finite or missing, of shape (n, p), got shape {arr.shape}")
    return list(enumerate(arr.T))


class TableEncoder:
    """Columns of any table as finite numbers, for learners that need them.

    Numbers stay, dates count days. A missing number becomes the median of its column, and an own column marks it if
    any was missing in training. Text and categories become one column per label, for up to 20 labels that occur in two
    rows or more; other labels are zero in all of them. A column without any value in training is zero, whatever comes.
    """

    def fit(self, X: Any) -> Self:
        """Learn the medians and labels of the columns."""
        self.columns_: list[tuple[float, bool] | list[str] | None] = []
        for _, values in columns_of(X):
            if values.dtype.kind == "f":
                gaps = np.isnan(values)
                known = None if gaps.all() else (float(np.median(values[~gaps])), bool(gaps.any()))
                self.columns_.append(known)
            else:
                labels, counts = np.unique(values, return_counts=True)
                order = np.argsort(-counts, kind="stable")[:_MOST_LABELS]
                self.columns_.append(labels[order[counts[order] >= _LEAST_ROWS]].tolist())
        return self

    def transform(self, X: Any) -> FloatArray:
        """The columns (n, q) of a table with as many columns as the one that was learnt."""
        found = columns_of(X, [j for j, known in enumerate(self.columns_) if isinstance(known, list)])
        if len(found) != len(self.columns_):
            raise ConformalError(f"X has {len(found)} columns, expected {len(self.columns_)}")
        parts: list[FloatArray] = []
        for (name, values), known in zip(found, self.columns_, strict=True):
            if known is None:
                parts.append(np.zeros(len(values)))
            elif isinstance(known, tuple) and values.dtype.kind == "f":
                gaps = np.isnan(values)
                parts += [np.where(gaps, known[0], values), *([gaps * 1.0] if known[1] else [])]
            elif isinstance(known, list) and values.dtype.kind != "f":
                parts += [(values == label) * 1.0 for label in known]
            else:
                what = ("numbers or dates", "text")[:: 1 if isinstance(known, tuple) else -1]
                raise ConformalError(f"column {name} held {what[0]} in training, got {what[1]}, {brief(values[:1])}")
        return np.column_stack(parts) if parts else np.empty((X.shape[0], 0))


def dense_inputs(X: Any) -> FloatArray | None:
    """Inputs (n, q) as numbers; None if they are sparse or hold what only the estimator can read, such as lists."""
    try:
        return None if issparse(X) else TableEncoder().fit(X).transform(X)
    except ConformalError:
        return None
