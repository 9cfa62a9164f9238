"""Tables (arrays; frames of pandas and polars) by rows, and as columns of finite numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from datetime import UTC, date, datetime
from decimal import Decimal
from numbers import Real
from typing import Any, Self

import numpy as np
from scipy.sparse import issparse

from conformodal.conformal.checks import as_doubles, brief, column_names, is_missing
from conformodal.core.arrays import AnyArray, FloatArray
from conformodal.core.errors import ConformodalError

# labels of a column of text that get a column each, the most frequent ones, each in at least two rows
_MAX_LABELS, _MIN_ROWS = 20, 2
_DAY = np.timedelta64(1, "D")
_ISO_DATE = re.compile(r"\d{4}-\d{2}-\d{2}(?:$|[T ]\d{2})|\d{8}T\d{4}")  # 20141013 alone may be a number
_HOURS, _MONDAY = 24.0, 3  # of a day; 1970-01-01 was a Thursday
_LARGEST = float(np.finfo(np.float32).max)  # that trees of scikit-learn split


def is_frame(X: Any) -> bool:
    """Whether `X` is a table with named columns, of pandas or polars."""
    return hasattr(X, "columns") and hasattr(X, "shape")


def numpy_columns(X: Any) -> Any:
    """A table of Arrow as a frame of pandas, and a frame whose columns are Arrow's with NumPy's; others as they are."""
    if any(str(dtype).endswith("[pyarrow]") for dtype in getattr(X, "dtypes", ())):
        import pyarrow as pa  # noqa: PLC0415 - whose columns they are

        return pa.Table.from_pandas(X, preserve_index=False).to_pandas(ignore_metadata=True).set_axis(X.index)
    return X.to_pandas(ignore_metadata=True) if hasattr(X, "column_names") else X


def column_of(X: Any, j: int) -> Any:
    """A column of a table, by its position."""
    return X.iloc[:, j] if hasattr(X, "iloc") else X[:, j]


def rows_of(X: Any, rows: Any) -> Any:
    """Some rows of a table, by a slice, a mask or positions: the same kind of table."""
    return X.iloc[rows] if hasattr(X, "iloc") else X[np.arange(X.shape[0])[rows]]


def as_column(column: Any, name: object, text: bool = False) -> AnyArray:
    """A column as float64, missing NaN and dates in days; or, of text and categories, as text, missing ``""``.

    Times with a time zone count in UTC. With `text`, objects of any kind and a column without any value are text too.
    """
    if getattr(getattr(column, "dtype", None), "tz", None) is not None:
        column = column.dt.tz_convert(None)
    arr = np.asarray(column)
    kind = str(getattr(column, "dtype", "")).lower()
    labels = kind.startswith(("categor", "enum"))
    if _is_pandas_text(column):  # each label once
        codes, distinct = column.factorize()
        return np.asarray(np.array([*map(str, distinct), ""], dtype=np.str_)[codes])
    labels |= text and arr.dtype.kind == "O"
    if arr.dtype.kind == "O" and not labels:
        present = [value for value in arr if not is_missing(value)]
        if all(isinstance(value, (Real, Decimal, np.bool_)) for value in present):
            arr = np.array([np.nan if is_missing(value) else float(value) for value in arr])
        elif all(isinstance(value, date) for value in present):
            arr = np.array([None if is_missing(v) else _without_zone(v) for v in arr], dtype="M8[us]")
    if arr.dtype.kind in "mM":
        arr = np.where(np.isnat(arr), np.nan, (arr - arr.dtype.type(0, "D") if arr.dtype.kind == "M" else arr) / _DAY)
    if arr.dtype.kind in "biuf" and not labels:
        numbers = arr.astype(np.float64)
        if np.isinf(numbers).any():
            raise ConformodalError(f"column {name} must be finite or missing, got inf in row {np.isinf(arr).argmax()}")
        return np.full(numbers.shape, "") if text and np.isnan(numbers).all() else numbers
    return np.array([_label(value) for value in arr], dtype=np.str_)


def _without_zone(value: date) -> date:
    aware = isinstance(value, datetime) and value.tzinfo is not None
    return value.astimezone(UTC).replace(tzinfo=None) if aware else value  # type: ignore[attr-defined]


def _is_pandas_text(column: Any) -> bool:
    return str(getattr(column, "dtype", "")).lower().startswith("str") and hasattr(column, "factorize")


def dates_of_text(column: Any) -> AnyArray | None:
    """Times (n,) in UTC of a column of ISO 8601 text with year, month and day; None if it holds anything else."""
    known: dict[Any, Any] = {}
    codes, distinct = None, column
    if _is_pandas_text(column):  # each text once
        codes, distinct = column.factorize()
    if first_other_than_dates(distinct, known) is not None or not known:
        return None
    times = np.array([known.get(value) for value in np.asarray(distinct, dtype=object)], dtype="M8[us]")
    return times if codes is None else np.append(times, np.datetime64("NaT"))[codes]  # -1: missing


def first_other_than_dates(column: Any, known: dict[Any, Any] | None = None) -> int | None:
    """The first row, from 0, that is neither missing nor ISO 8601 text of a date; the dates before it join `known`."""
    known = {} if known is None else known
    for row, value in enumerate(np.asarray(column, dtype=object)):
        if is_missing(value) or (isinstance(value, str) and value in known):
            continue
        if not (isinstance(value, str) and _ISO_DATE.match(value)):
            return row
        try:
            known[value] = _without_zone(datetime.fromisoformat(value))
        except ValueError:
            return row
    return None


def with_columns(X: Any, changed: dict[int, AnyArray]) -> Any:
    """A frame of pandas or polars with other values in some columns, by position; the given one stays as it is."""
    if not hasattr(X, "isetitem"):
        return X.with_columns([type(X[:, j])(X.columns[j], values) for j, values in changed.items()])
    X = X.copy(deep=False)
    for j, values in changed.items():
        X.isetitem(j, values)
    return X


def has_zone(column: Any) -> bool:
    """Whether a column holds times with a time zone."""
    dtype = getattr(column, "dtype", None)
    first = next((value for value in column if not is_missing(value)), None) if str(dtype) == "object" else dtype
    return any(getattr(first, name, None) is not None for name in ("tz", "time_zone", "tzinfo"))


def is_text(column: Any) -> bool:
    """Whether the first value of a column is text."""
    return isinstance(next((value for value in column if not is_missing(value)), None), str)


def is_empty(column: Any) -> bool:
    """Whether a column holds no value."""
    return all(is_missing(value) for value in column)


def is_time(column: Any) -> bool:
    """Whether a column holds dates or times."""
    first = next((value for value in column if not is_missing(value)), None)
    return isinstance(first, (date, np.datetime64))


def date_parts(days: FloatArray) -> dict[str, FloatArray]:
    """Year, month, day of the year, weekday and hour of times in days since 1970, of which none is missing."""
    times = np.rint(days * 86_400_000).astype("M8[ms]")
    day, month, year = (times.astype(f"M8[{unit}]") for unit in "DMY")
    return {
        "year": 1970.0 + year.astype(np.int64),
        "month": 1.0 + month.astype(np.int64) % 12,
        "day of the year": (day - year.astype("M8[D]")) / _DAY + 1,
        "weekday": (day.astype(np.int64) + _MONDAY) % 7 * 1.0,
        "hour": (days - np.floor(days)) * _HOURS,
    }


def varying_parts(values: FloatArray) -> list[str]:
    """The parts of dates, in days since 1970, that are not the same everywhere."""
    present = values[~np.isnan(values)]
    return [name for name, part in date_parts(present).items() if part.size and np.ptp(part)]


def _label(value: Any) -> str:
    """A value as text; gaps turn the whole numbers of a category into floats, which are the same labels."""
    if is_missing(value):
        return ""
    return str(int(value) if isinstance(value, float) and value.is_integer() else value)


def named_targets(y: Any, expected: list[str] | None) -> tuple[FloatArray, list[str] | None]:
    """Values to predict, (n,) or (n, d), and the names of a frame's or a series' columns."""
    if is_frame(y):
        names = column_names(y, "y", expected)
        return np.column_stack([as_doubles(column_of(y, j), f"y, {name},") for j, name in enumerate(names)]), names
    name = getattr(y, "name", None) if hasattr(y, "to_frame") else None  # of a series
    return as_doubles(y, f"y, {name}," if name else "y"), [str(name)] if name else None


def _finite_columns(X: Any) -> dict[int, FloatArray]:
    """Columns of floats in a frame of pandas, by position: at once, as there may be thousands; none if any is inf."""
    if not hasattr(X, "select_dtypes"):
        return {}
    places = np.flatnonzero(np.asarray(X.dtypes == "float64"))
    numbers = X.iloc[:, places].to_numpy()
    return {} if np.isinf(numbers).any() else dict(zip(places.tolist(), numbers.T, strict=True))


def columns_where(X: Any, holds: Callable[[Any], bool]) -> list[int]:
    """Positions of a frame's columns for which something holds that does not of floats; none of an array."""
    plain = _finite_columns(X)
    return [j for j in range(X.shape[1]) if j not in plain and holds(column_of(X, j))] if is_frame(X) else []


def columns_of(X: Any, text: Collection[int] = ()) -> list[AnyArray]:
    """The columns of a table, see :func:`as_column`; an array has numbers only."""
    if is_frame(X):
        whole = _finite_columns(X)
        return [
            whole[j] if j in whole and j not in text else as_column(column_of(X, j), name, j in text)
            for j, name in enumerate(X.columns)
        ]
    arr = as_doubles(X, "X")
    if arr.ndim != 2 or np.isinf(arr).any():
        raise ConformodalError(f"X must be finite or missing, of shape (n, p), got shape {arr.shape}")
    return list(arr.T)


class TableEncoder:
    """Columns of any table as finite numbers, for learners that need them.

    A missing number becomes the median of its column, and a column of its own marks it if any was missing in training.
    Text becomes one column per frequent label. Beside dates stand those of their parts that vary, as trees do not know
    that weekdays and hours repeat. A column without any value in training is zero, whatever comes.
    """

    def fit(self, X: Any) -> Self:
        """Learn the medians and labels of the columns."""
        self.columns_: list[tuple[float, bool] | list[str] | None] = []
        columns = columns_of(X)
        dated = {j: varying_parts(columns[j]) for j in columns_where(X, is_time)}
        self.parts_ = {str(j): names for j, names in dated.items()}  # keys as files of skops hold them
        for values in columns:
            if values.dtype.kind == "f":
                gaps = np.isnan(values)
                self.columns_.append(None if gaps.all() else (float(np.median(values[~gaps])), bool(gaps.any())))
            else:
                labels, counts = np.unique(values, return_counts=True)
                order = np.argsort(-counts, kind="stable")[:_MAX_LABELS]
                self.columns_.append(labels[order[counts[order] >= _MIN_ROWS]].tolist())
        return self

    def transform(self, X: Any) -> FloatArray:
        """The columns (n, q) of a table with as many columns as the one that was learnt."""
        columns = columns_of(X, [j for j, learnt in enumerate(self.columns_) if isinstance(learnt, list)])
        if len(columns) != len(self.columns_):
            raise ConformodalError(f"X has {len(columns)} columns, expected {len(self.columns_)}")
        parts: list[FloatArray] = [np.empty((len(X), 0))]
        for j, (column, learnt) in enumerate(zip(columns, self.columns_, strict=True)):
            name = X.columns[j] if is_frame(X) else j
            empty = isinstance(learnt, tuple) and column.dtype.kind != "f" and (column == "").all()
            values = np.full(len(column), np.nan) if empty else column  # the type of an empty column tells nothing
            if learnt is None:
                parts.append(np.zeros(len(values)))
            elif isinstance(learnt, tuple) and values.dtype.kind == "f":
                gaps = np.isnan(values)
                whole = np.where(gaps, learnt[0], values)
                if (beyond := np.abs(whole) > _LARGEST).any():
                    shown = f"got {whole[beyond.argmax()]:.7g}; if it means missing, make it NaN (--na-values)"
                    raise ConformodalError(f"column {name} must hold numbers within ±{_LARGEST:.1e}, {shown}")
                parts += [whole, *([gaps * 1.0] if learnt[1] else [])]
                if names := self.parts_.get(str(j)):
                    of_dates = date_parts(whole)
                    parts += [of_dates[name] for name in names]
            elif isinstance(learnt, list) and values.dtype.kind != "f":
                parts += [(values == label) * 1.0 for label in learnt]
            else:
                before = "text" if isinstance(learnt, list) else "numbers or dates"
                raise ConformodalError(f"column {name} held {before} in training, got {brief(values[:1].tolist())}")
        return np.column_stack(parts)


def dense_inputs(X: Any) -> FloatArray | None:
    """Inputs (n, q) as numbers; None if they are sparse or hold what only the estimator can read."""
    try:
        return None if issparse(X) else TableEncoder().fit(X).transform(X)
    except ConformodalError:
        return None
