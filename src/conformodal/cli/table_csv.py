"""Reading a CSV file: the separator and the decimal mark are recognised, and what is not clear is refused."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

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
_ONE_DECIMAL = r"[-+]?(\d*\{mark}(\d{{1,2}}|\d{{4,}})|(0|\d{{4,}})?\{mark}\d{{3}})"  # a mark between no thousands
_WITH_UNIT = (  # a limit, a currency, a number, and a unit: after a space, a sign, or letters that are no code
    r"^(?P<limit>[<>≤≥]=?)?\s*(?P<before>[$€£¥])?\s*(?P<number>[-+]?[\d.,' ]*\d[\d.,]*(?:[eE][-+]?\d+)?)"
    r"(?P<after>\s+[^\d\s.,;:-][^\d\s]{0,11}|[%‰°€$£¥][^\d\s]{0,3}|[mgls]|[^\W\d_]{2,12}(?:/[^\W\d_]+)?)?$"
)
_NUMBER = r"[-+]?[\d.,]*\d[\d.,]*(e[-+]?\d+)?"
_FEWEST_LINES = 3
_WORDS = ("NA", "N/A", "n/a", "NaN", "nan", "-NaN", "-nan", "NULL", "null", "None", "<NA>", "#NA", "#N/A")
_SPACES, _MINUS = "\u00a0\u2007\u2009\u202f", "\u2212"  # between thousands, and before negative numbers
_MAX_MISSING = 100  # words of a column that are remembered, the most frequent ones
_CODES = (-99, 99, -999, 999, -9999, 9999, -99999, 99999)  # often stand for missing values

# what a column holds: dates may have a known order of days and months, and NA is a label of text or a missing value
ColumnKind: TypeAlias = Literal["number", "date", "day first", "month first", "text", "text with NA"]


class TableError(ConformodalError):
    """A file that is not a table, or lacks what is asked for."""


@dataclass(frozen=True)
class CsvFormat:
    """How a CSV file is written, as :func:`pandas.read_csv` has it; None for what is recognised."""

    sep: str | None = None
    decimal: str | None = None
    thousands: str | None = None
    na_values: Sequence[str] = ()
    kinds: Mapping[str, ColumnKind] = field(default_factory=dict)  # of columns of the file learnt from
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict)  # text that was taken as missing there
    dates: Mapping[str, str] = field(default_factory=dict)  # formats of columns of dates, as of strptime
    units: Mapping[str, str] = field(default_factory=dict)  # of columns of the file learnt from; "" where there is none
    verbatim: Sequence[str] = ()  # columns that stay the text that is written, such as identifiers


def date_formats(given: Sequence[str]) -> dict[str, str]:
    """Formats of columns of dates from ``COLUMN=FORMAT``."""
    pairs = [one.partition("=") for one in given]
    if wrong := [name for name, _, form in pairs if not (name and form)]:
        raise TableError(f"--date must be COLUMN=FORMAT, such as 'sold=%d.%m.%y', got {wrong[0]!r}")
    return {name: form for name, _, form in pairs}


@dataclass
class ReadFormat:
    """How a file has turned out to be written, in ``attrs["format"]`` of its table."""

    kinds: dict[str, ColumnKind] = field(default_factory=dict)
    missing: dict[str, list[str]] = field(default_factory=dict)  # text of columns that hold numbers or dates
    units: dict[str, str] = field(default_factory=dict)
    unfit: dict[str, str] = field(default_factory=dict)  # columns that can be no target, and why


def read_table(file: Path, written: CsvFormat = CsvFormat()) -> tuple[pd.DataFrame, list[str]]:
    """A CSV file with its numbers and dates read, and notes on how.

    Commas, semicolons, tabs or bars separate; UTF-8, UTF-16 and the encoding of Western Windows are read. A column
    holds numbers or dates if 95 % of its values do; the others are then missing. The mark before decimals is that of
    most cells; where none leaves no doubt, a comma beside semicolons, else a point. Marks between thousands are read
    where `written` names them, or where they are spaces that do not break, and refused elsewhere. Words such as NA are
    labels in a column of text without empty cells, and missing values elsewhere. A column whose kind `written` names is
    read as that.
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
    decimal = written.decimal or _decimal_mark(cells, clear, separator)
    plain = numbers if decimal == "." and not written.thousands else {}
    reader, columns = _ColumnReader(file, separator, decimal, written), {}
    for name, raw in cells.items():
        if name in written.verbatim:
            columns[name] = _as_text(raw)
            continue
        column = clear.get(name, raw)
        if gone := written.missing.get(str(name)):
            column = column.mask(column.isin(gone))
        columns[name], told = reader.read(raw, column, plain.get(name))
        lost = column[columns[name].isna() & column.notna()]
        if len(lost):
            told = [*told, f"{counted(len(lost), 'value')} taken as missing, such as {_place(lost)}"]
            reader.form.missing[name] = lost.value_counts().index[:_MAX_MISSING].tolist()
        notes += [f"{name}: {note}" for note in told]
    frame = pd.DataFrame(columns, cells.index)
    frame.attrs["format"] = asdict(reader.form)
    return frame, notes


class _ColumnReader:
    """Reads the columns of a file, and gathers how they are written."""

    def __init__(self, file: Path, separator: str, decimal: str, written: CsvFormat) -> None:
        self.file, self.separator, self.decimal, self.written = file, separator, decimal, written
        self.form = ReadFormat()

    def read(self, raw: pd.Series, column: pd.Series, plain: FloatArray | None) -> tuple[pd.Series, list[str]]:
        """The values of a column, with missing words in it or without, that may be plain numbers; and notes."""
        name = str(column.name)
        if form := self.written.dates.get(name):
            return self._dates_as(column, form), []
        kind, reading = self.written.kinds.get(name), _Reading()
        if kind in (None, "number") and plain is not None:
            reading = _Reading(pd.Series(plain, column.index))
        elif kind in (None, "number"):
            reading = _numbers(self.file, column, self.decimal, self.written)
        if reading.unfit:
            self.form.unfit[name] = reading.unfit
        if reading.values is not None:
            self._check_unit(name, reading.unit)
            self.form.kinds[name] = "number"
            return reading.values, [*reading.notes, *_doubts(column, reading.values.to_numpy(), self.written)]
        dates = _dates(column, self.separator, kind) if kind in (None, "date", "day first", "month first") else None
        if dates is not None:
            self.form.kinds[name] = dates.attrs["kind"]
            at = (dates.dt.day != dates.dt.month).where(dates.notna(), False).idxmax()
            return dates, [*reading.notes, f"dates, of which {column[at]!r} is read as {dates[at]:%Y-%m-%d}"]
        text, self.form.kinds[name], more = _text_column(raw, column, kind)
        return text, [*reading.notes, *more]

    def _dates_as(self, column: pd.Series, form: str) -> pd.Series:
        try:
            dates = pd.to_datetime(column, format=form, errors="coerce", utc=True).dt.tz_localize(None)
        except ValueError as exc:
            raise TableError(f"--date {column.name}={form}: {exc}") from None
        lost = column[dates.isna() & column.notna()]
        if len(lost) > (1 - _MIN_SHARE) * column.notna().sum():
            raise TableError(f"{self.file}: column {column.name!r} must hold dates as {form}, got {_place(lost)}")
        return dates

    def _check_unit(self, name: str, unit: str) -> None:
        before = self.written.units.get(name, unit)
        if unit != before:
            units = [repr(one) if one else "no unit" for one in (unit, before)]
            raise TableError(f"{self.file}: column {name!r} has {units[0]}, and had {units[1]} in the file learnt from")
        if unit:
            self.form.units[name] = unit


def _text_column(raw: pd.Series, column: pd.Series, kind: ColumnKind | None) -> tuple[pd.Series, ColumnKind, list[str]]:
    """A column of text, its kind, and a note on words such as NA.

    These are labels if the `raw` column has other text and no empty cell, unless the kind is known.
    """
    if kind not in ("text", "text with NA"):
        kind = "text with NA" if raw.notna().all() and column.notna().any() else "text"
    text = _as_text(raw if kind == "text with NA" else column)
    words = raw[column.isna() & raw.notna()]
    if words.empty:
        return text, kind, []
    told = f"{words.iloc[0]!r} in {counted(len(words), 'cell')}"
    if kind == "text":
        return text, kind, [f"{told} is taken as missing"]
    return text, kind, [f"{told} is a label; --na-values={words.iloc[0]} if it means missing"]


def _read_parquet(file: Path) -> tuple[pd.DataFrame, list[str]]:
    """A Parquet file as a CSV file would be read: numbers in float64, times in UTC, all else as text."""
    try:
        frame = pd.read_parquet(file)
        named = [name for name in frame.index.names if name is not None]
        frame = frame.reset_index(named).reset_index(drop=True)
    except (OSError, ValueError) as exc:
        raise TableError(f"{file}: cannot be read as Parquet: {' '.join(str(exc).split())}") from None
    frame.columns = frame.columns.map(str)
    form = ReadFormat()
    for name, column in frame.items():
        if is_time(column):
            frame[name], form.kinds[name] = pd.to_datetime(column, utc=True).dt.tz_localize(None), "date"
            continue
        frame[name] = values = pd.Series(as_column(column, name)).replace("", None)
        if values.dtype.kind == "f":
            form.kinds[name] = "number"
        else:
            form.kinds[name] = "text with NA" if values.notna().all() or values.isin(_WORDS).any() else "text"
    frame.attrs["format"] = asdict(form)
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
        raw[j] = _as_text(pc.if_else(pc.equal(trimmed, ""), None, trimmed).to_pandas())
    return raw


def _as_text(column: pd.Series) -> pd.Series:
    """A column as text; pandas 2 writes 'None' and 'nan' into its gaps."""
    return column.astype("str").where(column.notna())


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
        usual, n_cells = (Counter(row[k] for row in rows).most_common(1)[0][0] if rows else 1 for k in (1, 2))
        wide = [row for row in rows if row[1] >= usual]
        # a first line with numbers, or more values than all others, is not that of the names if the next one can be
        while (
            len(wide) > _FEWEST_LINES
            and wide[1][3]
            and (not wide[0][3] or wide[0][1] > max(n for _, n, *_ in wide[1:]))
        ):
            del wide[0]
        above = wide[0][0] if wide else 0
        candidates.append((n_cells == 1, above, k, separator, max((n for _, _, n, _ in rows), default=1)))
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


@dataclass
class _Reading:
    """The numbers (n,) of a column, if it holds some, their unit, what is to be told, and why it can be no target."""

    values: pd.Series | None = None
    unit: str = ""
    notes: list[str] = field(default_factory=list)
    unfit: str = ""


def _numbers(file: Path, column: pd.Series, decimal: str, written: CsvFormat) -> _Reading:
    """The numbers of a column of text."""
    given = column.dropna().drop_duplicates()  # at the line where each occurs first
    codes = column.factorize()[0]
    times = np.bincount(codes[codes >= 0], minlength=len(given))
    if given.empty:
        return _Reading()
    text = given.str.replace(rf"(?<=\d)[{_SPACES}](?=\d{{3}}(?!\d))", "", regex=True).str.replace(_MINUS, "-")
    numbers, grouped = _parsed(text, decimal, written.thousands)
    parts = text.where(numbers.isna() & ~grouped).str.extract(_WITH_UNIT)
    inner, inner_grouped = _parsed(parts["number"], decimal, written.thousands)
    other = "," if decimal == "." else "."
    mixed = parts["number"].str.fullmatch(_ONE_DECIMAL.format(mark=other), na=False) & inner.isna()
    if written.decimal or written.thousands:
        mixed &= False
    inner = inner.fillna(pd.to_numeric(parts["number"].where(mixed).str.replace(",", "."), errors="coerce"))
    grouped |= inner_grouped & inner.isna()
    if times @ (numbers.notna() | inner.notna() | grouped) < _MIN_SHARE * times.sum():
        return _Reading()
    at = grouped | (numbers.notna() & text.str.fullmatch(_GROUPED) & mixed.any())
    if at.any():
        beside = f", as {_place(given[mixed])} has another mark before decimals" if mixed.any() else ""
        doubt = f"{_place(given[at])} may have marks between thousands{beside}"
        raise TableError(f"{file}: column {column.name!r}: {doubt}; give --thousands or --decimal")
    reading = _Reading()
    limits, marks = (
        inner.notna() & parts["limit"].notna(),
        parts["before"].fillna("") + parts["after"].fillna("").str.strip(),
    )
    units = marks.where(inner.notna(), "").where(numbers.notna() | inner.notna())
    names = list(dict.fromkeys(units.dropna()))
    if limits.any() and times @ limits > times.sum() / 2:
        return _Reading()
    if len(names) == 1:
        reading.unit = names[0]
        if reading.unit:
            reading.notes.append(f"numbers in {reading.unit!r}, of which {_place(given[units.notna()])}")
    else:
        first = [_place(given[units == name]) for name in names[:_SHOWN]]
        reading.unfit = f"has numbers in several units, or in none: {listed(first)}"
        inner = inner.where(marks == "")
        if times @ (numbers.notna() | inner.notna()) < _MIN_SHARE * times.sum():
            return _Reading(notes=[f"{reading.unfit}; read as text. Write all in one unit"], unfit=reading.unfit)
    limits &= inner.notna()
    if limits.any():
        reading.notes.append(
            f"{counted(int(times @ limits), 'value')}, such as {_place(given[limits])}, read as the limit"
        )
        reading.unfit = f"has values of which only a limit is known: {_place(given[limits])}"
    if mixed.any():
        name = "comma" if other == "," else "point"
        reading.notes.append(
            f"{counted(int(times @ mixed), 'value')}, such as {_place(given[mixed])}, read with a decimal {name}"
        )
    found = numbers.fillna(inner).astype(float).replace([np.inf, -np.inf], np.nan).to_numpy()
    reading.values = pd.Series(np.append(found, np.nan)[codes], column.index, name=column.name)
    return reading


def _place(cells: pd.Series) -> str:
    """The first of some cells, and where it is."""
    return f"{cells.iloc[0]!r} in line {cells.index[0]}"


def _parsed(text: pd.Series, decimal: str, thousands: str | None) -> tuple[pd.Series, pd.Series]:
    """The numbers of text, NaN where it holds none, and where marks may stand between thousands."""
    grouped = text.str.fullmatch(_GROUPED, na=False)
    digits = text
    if thousands:
        marked = text.str.contains(thousands, regex=False, na=False)
        digits = text.where(~marked | grouped).str.replace(thousands, "", regex=False)
    if decimal != ".":
        digits = digits.where(~digits.str.contains(".", regex=False, na=False)).str.replace(decimal, ".", regex=False)
    numbers = pd.to_numeric(digits, errors="coerce")
    return numbers, grouped & numbers.isna()


def _dates(column: pd.Series, separator: str, kind: ColumnKind | None) -> pd.Series | None:
    """Dates, in UTC where they have a time zone; None where they are none, or the month is not known."""
    codes, distinct = column.factorize()
    times = np.bincount(codes[codes >= 0], minlength=len(distinct))
    texts = pd.Series(np.asarray(distinct, dtype=object), dtype="str")
    dates, found = _recognised_dates(texts, times, separator, kind)
    if dates is None or times @ dates.notna() < _MIN_SHARE * times.sum():
        return None
    known = dates.dt.tz_localize(None).to_numpy()
    result = pd.Series(np.append(known, np.datetime64("NaT"))[codes], column.index)
    result.attrs["kind"] = found
    return result


def _recognised_dates(
    texts: pd.Series, times: IntArray, separator: str, kind: ColumnKind | None
) -> tuple[pd.Series | None, ColumnKind]:
    """Dates of distinct texts, of which each occurs some `times`, and their order; `kind` decides where they do not."""
    given = texts.str.replace(_COMPACT, r"\1-\2-\3 \4:\5:\6", regex=True)
    parts = given.str.extract(_DATE)
    if given.empty or times @ parts[0].notna() < _MIN_SHARE * times.sum():
        return None, "date"
    first, second = (pd.to_numeric(parts[k], errors="coerce") for k in (0, 2))
    year_first = first > 31
    day_first = bool((first[~year_first] > 12).any())
    month_first = bool((second[~year_first] > 12).any())
    if day_first and month_first:
        return None, "date"
    ordered = given[~year_first & first.notna() & second.notna()]  # neither the year nor the name of a month tells
    if not (day_first or month_first or ordered.empty):
        pointed = bool(ordered.str.match(r"\d+\.").all())
        day_first = kind == "day first" or (kind != "month first" and (separator == ";" or pointed))
    order: ColumnKind = "date" if ordered.empty else "day first" if day_first else "month first"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of days and months in another order
        how: dict[str, Any] = {"errors": "coerce", "format": "mixed", "utc": True}
        dates = pd.to_datetime(given.mask(year_first), dayfirst=day_first, **how)
        return dates.fillna(pd.to_datetime(given.where(year_first), **how)), order


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
