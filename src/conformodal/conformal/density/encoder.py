"""Tables of any kind (arrays; frames of pandas, polars and Arrow) by rows, and as columns of finite numbers."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from datetime import date, datetime
from decimal import Decimal
from numbers import Real
from typing import Any, Self

import numpy as np
from scipy.sparse import issparse

from conformodal.conformal.checks import as_doubles, brief, column_names, is_missing
from conformodal.conformal.errors import ConformodalError
from conformodal.core.arrays import AnyArray, FloatArray

# labels of a column of text that get a column each, the most frequent ones, each in at least two rows
_MOST_LABELS, _LEAST_ROWS = 20, 2
_DAY = np.timedelta64(1, "D")


def is_frame(X: Any) -> bool:
    """Whether `X` is a table with named columns: of pandas, polars or Arrow."""
    return hasattr(X, "columns") and hasattr(X, "shape")


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
    if hasattr(column, "combine_chunks"):  # of Arrow, whose chunks of categories fill gaps with a category
        column = column.combine_chunks()
    arr = np.asarray(column)
    if arr.ndim != 1 or arr.dtype.kind in "cV":
        raise ConformodalError(f"column {name} must hold numbers, dates or text, got {brief(column)}")
    kind = str(getattr(column, "dtype", getattr(column, "type", ""))).lower()
    labels = kind.startswith(("categor", "enum", "dictionary")) or (text and arr.dtype.kind == "O")
    if arr.dtype.kind == "O" and not labels:
        present = [value for value in arr if not is_missing(value)]
        if all(isinstance(value, (Real, Decimal, np.bool_)) for value in present):
            arr = np.array([np.nan if is_missing(value) else float(value) for value in arr])
        elif all(isinstance(value, date) for value in present):
            times = [None if is_missing(v) else v.replace(tzinfo=None) if isinstance(v, datetime) else v for v in arr]
            arr = np.array(times, dtype="M8[us]")
        elif not all(isinstance(value, (str, bytes, Real, date)) for value in present):
            raise ConformodalError(f"column {name} must hold numbers, dates or text, got {brief(present[:3])}")
    if arr.dtype.kind in "mM":
        arr = np.where(np.isnat(arr), np.nan, (arr - arr.dtype.type(0, "D") if arr.dtype.kind == "M" else arr) / _DAY)
    if arr.dtype.kind in "biuf" and not labels:
        numbers = arr.astype(np.float64)
        if np.isinf(numbers).any():
            raise ConformodalError(
                f"column {name} must be finite or missing, got inf in row {np.isinf(numbers).argmax()}"
            )
        return np.full(numbers.shape, "") if text and np.isnan(numbers).all() else numbers
    return np.array([_label(value) for value in arr], dtype=np.str_)


def _label(value: Any) -> str:
    """A value as text; gaps turn the whole numbers of a category into floats, which are the same labels."""
    if is_missing(value):
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)


def named_targets(y: Any, expected: list[str] | None) -> tuple[FloatArray, list[str] | None]:
    """Values to predict, (n,) or (n, d), and the names of a frame's or a series' columns."""
    if is_frame(y):
        names = column_names(y, "y", expected)
        columns = [as_doubles(column_of(y, j), f"y, {name},") for j, name in enumerate(names)]
        return np.column_stack(columns or [np.empty((y.shape[0], 0))]), names
    name = getattr(y, "name", None) if hasattr(y, "to_frame") else None  # of a series
    return as_doubles(y, f"y, {name}," if name else "y"), [str(name)] if name else None


def columns_of(X: Any, text: Collection[int] = ()) -> list[tuple[Hashable, AnyArray]]:
    """Names and values of the columns of a table, see :func:`as_column`; an array has numbers only."""
    if is_frame(X):
        names = column_names(X, "X", None)
        return [(name, as_column(column_of(X, j), name, j in text)) for j, name in enumerate(names)]
    arr = as_doubles(X, "X")
    if arr.ndim != 2 or np.isinf(arr).any():
        raise ConformodalError(f"X must be finite or missing, of shape (n, p), got shape {arr.shape}")
    return list(enumerate(arr.T))


class TableEncoder:
    """Columns of any table as finite numbers, for learners that need them.

    Numbers stay, dates count days. A missing number becomes the median of its column, and a column of its own marks it
    if any was missing in training. Text and categories become one column per label, for up to 20 labels that occur in
    two rows or more; other labels are zero in all of them. A column without any value in training is zero, whatever
    comes.
    """

    def fit(self, X: Any) -> Self:
        """Learn the medians and labels of the columns."""
        self.columns_: list[tuple[float, bool] | list[str] | None] = []
        for _, values in columns_of(X):
            if values.dtype.kind == "f":
                gaps = np.isnan(values)
                self.columns_.append(None if gaps.all() else (float(np.median(values[~gaps])), bool(gaps.any())))
            else:
                labels, counts = np.unique(values, return_counts=True)
                order = np.argsort(-counts, kind="stable")[:_MOST_LABELS]
                self.columns_.append(labels[order[counts[order] >= _LEAST_ROWS]].tolist())
        return self

    def transform(self, X: Any) -> FloatArray:
        """The columns (n, q) of a table with as many columns as the one that was learnt."""
        columns = columns_of(X, [j for j, learnt in enumerate(self.columns_) if isinstance(learnt, list)])
        if len(columns) != len(self.columns_):
            raise ConformodalError(f"X has {len(columns)} columns, expected {len(self.columns_)}")
        parts: list[FloatArray] = [np.empty((len(X), 0))]
        for (name, values), learnt in zip(columns, self.columns_, strict=True):
            if learnt is None:
                parts.append(np.zeros(len(values)))
            elif isinstance(learnt, tuple) and values.dtype.kind == "f":
                gaps = np.isnan(values)
                parts += [np.where(gaps, learnt[0], values), *([gaps * 1.0] if learnt[1] else [])]
            elif isinstance(learnt, list) and values.dtype.kind != "f":
                parts += [(values == label) * 1.0 for label in learnt]
            else:
                what = ("numbers or dates", "text")[:: 1 if isinstance(learnt, tuple) else -1]
                raise ConformodalError(f"column {name} held {what[0]} in training, got {what[1]}, {brief(values[:1])}")
        return np.column_stack(parts)


def dense_inputs(X: Any) -> FloatArray | None:
    """Inputs (n, q) as numbers; None if they are sparse or hold what only the estimator can read, such as lists."""
    try:
        return None if issparse(X) else TableEncoder().fit(X).transform(X)
    except ConformodalError:
        return None
