"""Reading a CSV file: the separator and the decimal mark are recognised, and what is not clear is refused."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from conformodal.conformal.density.encoder import as_column, is_time
from conformodal.core.arrays import AnyArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.files import read_file
from conformodal.core.words import counted, listed

_SEPARATORS, _SAMPLE = ";\t,|", 1_000_000  # characters
_SHOWN = 3  # names in a message
_MIN_SHARE = 0.95  # of a column's values that must be numbers, or dates, for it to hold them
_DATE = (  # with a year of four digits, or two at the end
    r"^((?P<year>\d{4})|\d{1,2})[-./ ](\d{1,2}|[A-Za-z]{3,9})[-./ ,]{1,2}(?(year)\d{1,2}|\d{2}(?:\d{2})?)(?!\d)"
)
_COMPACT = r"^(\d{4})(\d{2})(\d{2})T(\d{2})(\d{2})(\d{2})$"  # ISO 8601 without marks
_GROUPED = r"[-+]?[1-9]\d{0,2}([.,' ])\d{3}(?:\1\d{3})*(?:[.,]\d*)?"  # marks between thousands
_NUMBER = r"[-+]?[\d.,]*\d[\d.,]*(e[-+]?\d+)?"
_FEWEST_LINES = 3
_WORDS = ("NA", "N/A", "n/a", "NaN", "nan", "-NaN", "-nan", "NULL", "null", "None", "<NA>", "#NA", "#N/A")
_SPACES, _MINUS = "\u00a0\u2007\u2009\u202f", "\u2212"  # between thousands, and before negative numbers
_CODES = (-99, 99, -999, 999, -9999, 9999, -99999, 99999)  # often stand for missing values


class TableError(ConformodalError):
    """A file that is not a table, or lacks what is asked for."""


@dataclass(frozen=True)
class CsvFormat:
    """How a CSV file is written, as :func:`pandas.read_csv` has it; None for what is recognised."""

    sep: str | None = None
    decimal: str | None = None
    thousands: str | None = None
    na_values: Sequence[str] = ()
    day_first: Sequence[str] = ()  # columns of dates whose days come before their months where nothing else tells
    labels: Sequence[str] = ()  # columns of text in which "None" and "NA" are labels
    verbatim: Sequence[str] = ()  # columns that stay the text that is written, such as identifiers


def read_table(file: Path, written: CsvFormat = CsvFormat()) -> tuple[pd.DataFrame, list[str]]:
    """A CSV file with its numbers and dates read, and notes on how.

    Commas, semicolons, tabs or bars separate; UTF-8, UTF-16 and the encoding of Western Windows are read. A column
    holds numbers or dates if 95 % of its values do; the others are then missing. The mark before decimals is that of
    most cells; where none leaves no doubt, a comma beside semicolons, else a point. Marks between thousands are read
    where `written` names them, or where they are spaces that do not break, and refused elsewhere. Words such as NA are
    labels in a column of text without empty cells, and missing values elsewhere.
    """
    if file.suffix == ".parquet":
        return _read_parquet(file)
    for name, mark in (("sep", written.sep), ("decimal", written.decimal), ("thousands", written.thousands)):
        if mark is not None and len(mark) != 1:
            raise TableError(f"--{name} must be one character, got {mark!r}")
    text = _text(file)
    above, separator, width = _arrangement(text, file, written.sep or _SEPARATORS)
    raw = _rows(text, file, {"sep": separator, "skiprows": above, "names": range(width)}, written.na_values)
    raw.index = _lines(text, above, separator, len(raw))
    cells = _named_cells(raw, file, separator)
    notes = [f"{file}: {counted(len(cells), 'row')}, {counted(cells.shape[1], 'column')} separated by {separator!r}"]
    notes += [f"{counted(above, 'line')} above the names passed over"] if above else []
    numbers = _plain_numbers(cells)
    others = cells.drop(columns=list(numbers)).astype(object)
    joined = np.flatnonzero(_each(others, lambda cell: cell.str.contains(r"[\r\n]", na=False)).any(axis=1))
    if joined.size:
        number = counted(joined.size, "row has values", "rows have values")
        notes.append(
            f"{number} of several lines, such as line {cells.index[joined[0]]}; a quote that is not closed joins rows"
        )
    words = _each(others, lambda cell: cell.isin(_WORDS)).astype(np.bool_)
    clear = others.mask(words) if words.any() else others
    decimal, columns, day_first = written.decimal or _decimal_mark(cells, clear, separator), {}, list[str]()
    labels = list[str]()
    plain = numbers if decimal == "." and not written.thousands else {}
    for name, raw in cells.items():
        column = clear.get(name, raw)
        if name in written.verbatim:
            columns[name] = raw.astype("str")
            continue
        if name in plain:
            columns[name] = plain[name]
            notes += [f"{name}: {note}" for note in _doubts(column, plain[name], written)]
            continue
        values = _numbers(file, column, decimal, written.thousands)
        if values is None:
            values = _dates(column, separator, str(name) in written.day_first)
            day_first += [] if values is None or not values.attrs["day_first"] else [str(name)]
        if values is None:
            values, more = _text_column(raw, column, name in written.labels)
            labels += [str(name)] if values.notna().sum() > column.notna().sum() else []
            notes += more
        columns[name] = values
        if values.dtype.kind == "M":
            at = (values.dt.day != values.dt.month).where(values.notna(), False).idxmax()
            notes.append(f"{name}: dates, of which {column[at]!r} is read as {values[at]:%Y-%m-%d}")
        elif values.dtype.kind == "f":
            notes += [f"{name}: {note}" for note in _doubts(column, values.to_numpy(), written)]
        if len(lost := column[values.isna() & column.notna()]):
            notes.append(f"{name}: {counted(len(lost), 'value')} taken as missing, such as {lost.iloc[0]!r}")
    frame = pd.DataFrame(columns, cells.index)
    frame.attrs["day_first"], frame.attrs["labels"] = day_first, labels
    return frame, notes


def _text_column(raw: pd.Series, column: pd.Series, labelled: bool) -> tuple[pd.Series, list[str]]:
    """A column of text, and a note on words such as NA: labels if the `raw` column has other text and no empty cell."""
    words = raw[column.isna() & raw.notna()]
    if words.empty:
        return column.astype("str"), []
    told = f"{column.name}: {words.iloc[0]!r} in {counted(len(words), 'cell')}"
    if labelled or (raw.notna().all() and column.notna().any()):
        return raw.astype("str"), [f"{told} is a label; --na-values={words.iloc[0]} if it means missing"]
    return column.astype("str"), [f"{told} is taken as missing"]


def _read_parquet(file: Path) -> tuple[pd.DataFrame, list[str]]:
    """A Parquet file as a CSV file would be read: numbers in float64, times in UTC, all else as text."""
    try:
        frame = pd.read_parquet(file).reset_index(drop=True)
    except (OSError, ValueError) as exc:
        raise TableError(f"{file}: cannot be read as Parquet: {' '.join(str(exc).split())}") from None
    for name, column in frame.items():
        if is_time(column):
            frame[name] = pd.to_datetime(column, utc=True).dt.tz_localize(None)
        else:
            frame[name] = pd.Series(as_column(column, name)).replace("", None)
    frame.attrs["day_first"], frame.attrs["labels"] = [], []
    return frame, [f"{file}: {counted(len(frame), 'row')}, {counted(frame.shape[1], 'column')}"]


def _lines(text: str, above: int, separator: str, n: int) -> IntArray:
    """The line (n,) of each row in the file, from 1: values may hold line breaks, and empty lines are no rows."""
    if text.count("\n") + (not text.endswith("\n")) == above + n:
        return above + 1 + np.arange(n)
    starts, at = [], 0
    with suppress(csv.Error):
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True)
        for row in reader:
            if at >= above and (len(row) > 1 or "".join(row).strip()):
                starts.append(at + 1)
            at = reader.line_num
    return np.array(starts) if len(starts) == n else above + 1 + np.arange(n)


def _rows(text: str, file: Path, shape: dict[str, Any], na_values: Sequence[str]) -> pd.DataFrame:
    """The text of all cells, names among them, without blanks around it."""
    shape |= {
        "keep_default_na": False,
        "na_values": ["", *na_values],
        "header": None,
        "skipinitialspace": True,
        "index_col": False,
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of rows longer than those looked at
            raw = pd.read_csv(io.BytesIO(text.encode()), dtype="str", **shape)
    except (ValueError, pd.errors.ParserError, pd.errors.ParserWarning) as exc:
        raise TableError(f"{file}: cannot be read as CSV: {' '.join(str(exc).split())}") from None
    if raw.empty:
        raise TableError(f"{file}: cannot be read as CSV: holds no values")
    for j, column in raw.items():
        trimmed = pc.utf8_trim_whitespace(pa.array(column, from_pandas=True, type=pa.large_string()))
        raw[j] = pd.Series(pc.if_else(pc.equal(trimmed, ""), None, trimmed).to_pandas(), dtype="str")
    return raw


def _each(cells: pd.DataFrame, change: Callable[[pd.Series], pd.Series]) -> AnyArray:
    """A change of every cell, in one go: a thousand columns of their own take seconds."""
    changed = change(pd.Series(cells.to_numpy(dtype=object).ravel(), dtype="str"))
    return np.asarray(changed, dtype=object).reshape(cells.shape)


def _named_cells(raw: pd.DataFrame, file: Path, separator: str) -> pd.DataFrame:
    """The cells below the names, which head the columns; names that are not clear are refused."""
    head, raw = raw.iloc[0], raw[1:]
    n_named = int(np.flatnonzero(head.notna())[-1]) + 1
    quotes = f"values that hold {separator!r}, as decimal commas, need quotes or another separator"
    more = np.flatnonzero(raw.iloc[:, n_named:].notna().any(axis=1))
    if more.size:
        raise TableError(
            f"{file}: line {raw.index[more[0]]} has more values than the {n_named} names of columns; {quotes}"
        )
    names = [f"column {j + 1}" if pd.isna(name) else str(name) for j, name in enumerate(head[:n_named])]
    if pd.to_numeric(pd.Series(names), errors="coerce").notna().all():
        raise TableError(f"{file}: expected names above the columns, got {', '.join(names[:_SHOWN])}; {quotes}")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise TableError(f"{file}: several columns are called {listed(twice)}; rename them")
    return raw.iloc[:, :n_named].set_axis(names, axis=1)


def _text(file: Path) -> str:
    try:
        content = read_file(file)
    except OSError as exc:
        raise TableError(f"{file}: cannot be read: {exc.strerror}") from None
    marked = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    if b"\0" in content and not marked:
        raise TableError(f"{file}: is not text; save the spreadsheet as CSV")
    for encoding in ["utf-16"] if marked else ["utf-8-sig", "cp1252"]:
        with suppress(UnicodeDecodeError):
            return content.decode(encoding)
    raise TableError(f"{file}: its text cannot be decoded as UTF-8 or UTF-16; save it as CSV in UTF-8")


def _arrangement(text: str, file: Path, separators: str) -> tuple[int, str, int]:
    """Lines above the names, the separator, and the most values of a row.

    Most rows have equally many values, more than one; names have as many. Of several separators, the one with the least
    above the names is right.
    """
    candidates = []
    for k, separator in enumerate(separators):
        reader = csv.reader(io.StringIO(text[:_SAMPLE], newline=""), delimiter=separator, skipinitialspace=True)
        rows, at = [], 0
        try:
            for row in reader:
                filled = [i for i, value in enumerate(row, start=1) if value.strip()]
                names = len(filled) == len(set(row)) and not any(re.fullmatch(_NUMBER, value.strip()) for value in row)
                rows += [(at, filled[-1], len(row), names)] if filled else []
                at = reader.line_num
        except csv.Error:  # a value longer than Python's limit
            continue
        usual = Counter(n for _, n, *_ in rows).most_common(1)[0][0] if rows else 1
        wide = [row for row in rows if row[1] >= usual]
        # a first line with numbers, or more values than all others, is not that of the names if the next one can be
        while (
            len(wide) > _FEWEST_LINES
            and wide[1][3]
            and (not wide[0][3] or wide[0][1] > max(n for _, n, *_ in wide[1:]))
        ):
            del wide[0]
        above = wide[0][0] if wide else 0
        candidates.append((usual == 1, above, k, separator, max((n for _, _, n, _ in rows), default=1)))
    if len(candidates) < len(separators) and all(single for single, *_ in candidates):
        raise TableError(f"{file}: a value has more than {csv.field_size_limit()} characters; is a quote not closed?")
    _, above, _, separator, width = min(candidates)
    return above, separator, width


def _decimal_mark(cells: pd.DataFrame, others: pd.DataFrame, separator: str) -> str:
    """The mark before decimals in most cells; only `others` than plain numbers, of a point, may hold commas."""
    marks = Counter[str]()
    for mark, other in (",.", ".,"):  # three digits may follow a mark between thousands, but not after 0 or 1234
        pattern = rf"[-+]?([\d' {other}]*\{mark}(\d{{1,2}}|\d{{4,}})|(0|\d{{4,}})?\{mark}\d{{3}})"
        given = others if mark == "," else cells
        marks[mark] = int(_each(given, lambda cell, pattern=pattern: cell.str.fullmatch(pattern, na=False)).sum())  # type: ignore[misc]
        if not marks[","] and separator != ";":
            return "."
    if marks["."] == marks[","]:
        return "," if separator == ";" else "."
    return max(marks, key=lambda mark: marks[mark])


def _plain_numbers(cells: pd.DataFrame) -> dict[Any, FloatArray]:
    """The columns that hold finite numbers, with a point if any, and gaps alone."""
    plain = {}
    for name, column in cells.items():
        text = pa.array(column, from_pandas=True, type=pa.large_string())
        with suppress(pa.ArrowInvalid):
            numbers = pc.cast(text, pa.float64()).to_numpy(zero_copy_only=False)
            if np.isfinite(numbers).sum() == len(text) - text.null_count > 0:
                plain[name] = numbers
    return plain


def _numbers(file: Path, column: pd.Series, decimal: str, thousands: str | None) -> pd.Series | None:
    """The numbers of a column of text; None if it holds none."""
    given = column.dropna()
    given = given.str.replace(rf"(?<=\d)[{_SPACES}](?=\d{{3}}(?!\d))", "", regex=True).str.replace(_MINUS, "-")
    grouped = given.str.fullmatch(_GROUPED)
    digits = given
    if thousands:
        marked = given.str.contains(thousands, regex=False)
        digits = given.where(~marked | grouped).str.replace(thousands, "", regex=False)
    if decimal != ".":
        digits = digits.where(~digits.str.contains(".", regex=False, na=False)).str.replace(decimal, ".", regex=False)
    numbers = pd.to_numeric(digits, errors="coerce")
    grouped &= numbers.isna()
    if given.empty or (numbers.notna() | grouped).mean() < _MIN_SHARE:
        return None
    if grouped.any():
        doubt = f"{given[grouped].iloc[0]!r} may have marks between thousands"
        raise TableError(f"{file}: column {column.name!r}: {doubt}; give --thousands or --decimal")
    return numbers.astype(float).replace([np.inf, -np.inf], np.nan).reindex(column.index)


def _dates(column: pd.Series, separator: str, prefers_day_first: bool) -> pd.Series | None:
    """Dates, in UTC where they have a time zone; None where they are none, or the month is not known."""
    given = column.dropna().str.replace(_COMPACT, r"\1-\2-\3 \4:\5:\6", regex=True)
    parts = given.str.extract(_DATE)
    if given.empty or parts[0].notna().mean() < _MIN_SHARE:
        return None
    first, second = (pd.to_numeric(parts[k], errors="coerce") for k in (0, 2))
    year_first = first > 31
    day_first = bool((first[~year_first] > 12).any())
    month_first = bool((second[~year_first] > 12).any())
    if day_first and month_first:
        return None
    pointed = bool(given[~year_first].str.match(r"\d+\.").all())
    day_first |= not month_first and (prefers_day_first or separator == ";" or pointed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of days and months in another order
        how: dict[str, Any] = {"errors": "coerce", "format": "mixed", "utc": True}
        dates = pd.to_datetime(given.mask(year_first), dayfirst=day_first, **how)
        dates = dates.fillna(pd.to_datetime(given.where(year_first), **how))
    dates = dates.dt.tz_localize(None).reindex(column.index)
    dates.attrs["day_first"] = day_first
    return dates if dates.notna().sum() >= _MIN_SHARE * len(given) else None


def _all_grouped(marked: pd.Series) -> bool:
    return bool(re.fullmatch(_GROUPED, marked.iloc[0])) and bool(marked.str.fullmatch(_GROUPED).all())


def _doubts(column: pd.Series, numbers: FloatArray, written: CsvFormat) -> list[str]:
    """Notes on numbers that could mean another thing."""
    notes = []
    present = ~np.isnan(numbers)
    marked = np.flatnonzero(present & column.str.contains("[.,]", na=False).to_numpy(dtype=np.bool_))
    if marked.size and not (written.decimal or written.thousands) and _all_grouped(column.iloc[marked]):
        cell, number = column.iloc[marked[0]], numbers[marked[0]]
        notes.append(f"{cell!r} is read as {number:.12g}; else name --thousands or --decimal")
    codes = numbers[np.isin(numbers, _CODES)]
    if len(codes) > 1 and codes[0] in (np.nanmin(numbers), np.nanmax(numbers)):
        notes.append(f"{codes[0]:g} occurs {len(codes)} times; --na-values={codes[0]:g} if it means missing")
    return notes
