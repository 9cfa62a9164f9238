"""``conformodal table``: regions and their coverage from a CSV file as a spreadsheet writes it."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from conformodal.conformal import ConformalRegressor, ConformodalError, Diagnosis
from conformodal.conformal.learning.saving import check_replaceable
from conformodal.core.extras import require_extra
from conformodal.core.files import replacing
from conformodal.core.words import counted, listed

from .console import report_errors, report_line, warning_lines

_FEWEST_ROWS = 50  # a fifth is tested, and a fifth of the rest calibrates
_SHOWN, _NAMED, _FEW = 3, 20, 1000  # rows, columns, rows
_LEAST_SHARE = 0.95  # of a column's values that must be numbers, or dates, for it to hold them
_MOST_MISSING, _MOST_DISTINCT = 0.5, 0.9
_PICTURES = (".svg", ".png", ".pdf")
_DATE = (  # with a year of four digits, or two at the end
    r"^((?P<year>\d{4})|\d{1,2})[-./ ](\d{1,2}|[A-Za-z]{3,9})[-./ ,]{1,2}(?(year)\d{1,2}|\d{2}(?:\d{2})?)(?!\d)"
)
_PARTS = (  # brackets in pairs, and one sign
    r"^(?P<open>\()?(?P<sign>[-+])?(?P<currency>[$\u20ac\u00a3\u00a5]?)(?P<number>[\d.,]*\d[.,]?(?:[eE][-+]?\d+)?)"
    r"(?P<unit>[^-\d.,()]{0,6})(?P<end>(?(sign)|-?))(?(open)\))$"
)
_BLANKS = re.compile(  # between thousands, and anywhere but between digits
    r"(?<=\d)(?<!\d{4})[\s'\u2019](?=\d{3}(?!\d))|(?<![\d\s])[\s'\u2019]+|\s+(?![\d\s])"
)
_CODES = [sign * (10**k - 1) for k in (2, 3, 4, 5) for sign in (-1, 1)]  # of values that are missing
_SEPARATORS, _LOOKED_AT = ";\t,|", 1_000_000  # characters


class TableError(ConformodalError):
    """A file that is not a table, or lacks what is asked for."""


@report_errors
def table(
    file: Annotated[Path, typer.Argument(help="CSV file with a line of column names.")],
    target: Annotated[list[str], typer.Option(help="Column to predict; repeat it for several, covered together.")],
    group: Annotated[
        list[str] | None, typer.Option(help="Column whose values are groups: coverage is guaranteed in each.")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(help="Column to leave out, such as one known after the target; repeatable.")
    ] = None,
    alpha: Annotated[str, typer.Option(help="Miscoverage rate.")] = "0.1",
    seed: Annotated[int, typer.Option(help="Seed of the split and of the learner.")] = 0,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of sets and coverage, .svg, .png or .pdf; needs the extra 'figures'.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="File for the fitted regressor, for ConformalRegressor.load; extra 'save'.")
    ] = None,
) -> None:
    """Learn columns of a CSV file from the others; print regions of unseen rows and their coverage."""
    _check_outputs(plot, model)
    frame, notes = read_table(file)
    if len(group or []) > 1:
        raise TableError(f"--group names one column, got {listed(group or [])}; ConditionalConformal takes several")
    by = group[0] if group else None
    X, y, more = choose_columns(frame, target, by, str(file), exclude or [])
    for note in (*notes, *more):
        report_line(note)
    test, train = np.split(np.random.default_rng(seed).permutation(len(X)), [len(X) // 5])
    joint: Any = "max" if len(target) > 1 else "none"
    reg = ConformalRegressor(alpha=alpha, joint=joint, random_state=seed, groups=by, verbose=True)
    with warning_lines(UserWarning, lambda text: report_line(f"note: {text}")):
        reg.fit(X.iloc[train], y.iloc[train])
    regions = reg.predict_region(X.iloc[test])
    for row in sorted({*range(_SHOWN), int((regions.n_intervals > 1).any(axis=1).argmax())}):
        for name, parts in zip(target, regions.intervals(row), strict=True):
            ranges = " or ".join(f"{low:.4g} to {high:.4g}" for low, high in parts) or "no value"
            true = y[name].iloc[test[row]]
            report_line(f"row {X.index[test[row]] + 1}, {name}: {ranges} (true: {true:.4g})")
    several = (regions.n_intervals > 1).any(axis=1).mean()
    report_line(f"rows with several intervals: {several:.0%}")
    found = reg.diagnose(X.iloc[test], y.iloc[test])
    for line in str(found).splitlines():
        report_line(line)
    if model is not None:
        reg.save(model)
        report_line(f"regressor: {model.resolve()}")
    if plot is not None:
        _draw(reg, X.iloc[test], y.iloc[test], found, plot)


def _check_outputs(plot: Path | None, model: Path | None) -> None:
    """Refuse to write over what this command has not written, and without the extras, before any work begins."""
    if plot is not None and plot.suffix not in _PICTURES:
        raise TableError(f"{plot}: the name of a picture ends with {', '.join(_PICTURES)}")
    if plot is not None and plot.exists() and not (plot.is_file() and b"conformodal" in plot.read_bytes()):
        raise TableError(f"{plot}: exists and is not a picture of this command, not replaced; name another file")
    if model is not None:
        check_replaceable(model)
    for option, value, extra, package in (
        ("--plot", plot, "figures", "matplotlib"),
        ("--model", model, "save", "skops"),
    ):
        if value is not None:
            with require_extra(extra, option):
                import_module(package)


def _draw(reg: ConformalRegressor, X: pd.DataFrame, y: pd.DataFrame, found: Diagnosis, plot: Path) -> None:
    """Draw sets and density of every target over the rows, from the smallest predicted mean on, beside the coverage."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    from conformodal.report.tables import draw_coverage, draw_regions  # noqa: PLC0415

    density, regions, n_targets = reg.predict_density(X), reg.predict_region(X), y.shape[1]
    figure = Figure(figsize=(12, 4 * n_targets), layout="constrained")
    grid = figure.subplots(n_targets, 2, squeeze=False, width_ratios=(3, 2))
    for j, (left, right) in enumerate(grid):
        rank = density.mean[:, j].argsort(kind="stable").argsort()
        draw_regions(regions, y, pd.Series(rank, name="unseen rows, by predicted mean"), density, j, left)
        if j < len(found.columns):
            draw_coverage(found, j, right)
        else:
            right.set_axis_off()
    with replacing(plot) as part:
        figure.savefig(part, format=plot.suffix[1:], metadata={"Creator": "conformodal"})
    report_line(f"picture: {plot.resolve()}")


def read_table(file: Path) -> tuple[pd.DataFrame, list[str]]:
    """A CSV file with its numbers and dates read, and what was found.

    Commas, semicolons, tabs or bars separate; UTF-8, UTF-16 and the encoding of Western Windows are read. A column
    holds numbers or dates if 95 % of its values are; the others are then missing. Where 1.125 or 1,125 could mean two
    things, the column's other numbers decide, then other columns, then the separator: beside semicolons a comma is
    decimal, beside others a point; the other mark groups thousands if commas separate or the column has whole numbers.
    """
    raw, names, separator, notes = _cells(file)
    parts = [_parts(raw[name].dropna()) for name in names]
    points = [_points(digits) for digits, _ in parts]
    certain = {its for its in points if len(its) == 1}
    columns = {}
    for name, (digits, unit), point in zip(names, parts, points, strict=True):
        column = raw[name]
        columns[name] = found = _converted(column, digits, point, certain, separator)
        told = []
        if found.dtype.kind == "M":
            at = (found.dt.day != found.dt.month).where(found.notna(), False).idxmax()
            told.append(f"dates, of which {column[at]!r} is read as {found[at]:%Y-%m-%d}")
        elif found.dtype.kind == "f":
            told += [f"numbers without their {unit!r}"] if unit else []
            grouped = found[digits.index[_grouped(digits)] if len(point) > 1 else []].dropna()
            unlike = grouped.index[grouped != pd.to_numeric(digits[grouped.index], errors="coerce")]
            bracketed = column.index[column.str.startswith("(", na=False) & found.notna()]
            told += [f"{column[at]!r} is read as {found[at]:.12g}" for at in (*unlike[:1], *bracketed[:1])]
            codes = found[found.isin(_CODES)]
            if len(codes) > 1 and codes.iloc[0] in (found.min(), found.max()):
                told.append(f"{codes.iloc[0]:g} occurs {len(codes)} times; leave cells empty if it means missing")
        if len(lost := column[found.isna() & column.notna()]):
            told.append(f"{counted(len(lost), 'value')} taken as missing, such as {lost.iloc[0]!r}")
        notes += [f"{name}: {words}" for words in told]
    return pd.DataFrame(columns), notes


def _cells(file: Path) -> tuple[pd.DataFrame, list[str], str, list[str]]:
    """The text of all cells, without blanks around it; the columns' names, the separator, and what was found."""
    text = _text(file)
    above, separator, width = _arrangement(text, file)
    shape: dict[str, Any] = {"sep": separator, "skiprows": above, "header": None, "names": range(width)}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of rows longer than those looked at
            raw = pd.read_csv(io.StringIO(text), dtype=str, skipinitialspace=True, index_col=False, **shape)
    except (ValueError, pd.errors.ParserError, pd.errors.ParserWarning) as exc:
        raise TableError(f"{file}: cannot be read as CSV: {' '.join(str(exc).split())}") from None
    if raw.empty:
        raise TableError(f"{file}: cannot be read as CSV: holds no values")
    raw = raw.apply(lambda column: column.str.strip().replace("", None))
    head, raw = raw.iloc[0], raw[1:].reset_index(drop=True)
    n_named = int(np.flatnonzero(head.notna())[-1]) + 1
    quotes = f"values that hold {separator!r}, as decimal commas, need quotes or another separator"
    more = np.flatnonzero(raw.iloc[:, n_named:].notna().any(axis=1))
    if more.size:
        raise TableError(f"{file}: row {more[0] + 1} has more values than the {n_named} names of columns; {quotes}")
    names = [f"column {j + 1}" if pd.isna(name) else str(name) for j, name in enumerate(head[:n_named])]
    if pd.to_numeric(pd.Series(names), errors="coerce").notna().all():
        raise TableError(f"{file}: expected names above the columns, found {', '.join(names[:_SHOWN])}; {quotes}")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise TableError(f"{file}: several columns are called {listed(twice)}; give each a name of its own")
    notes = [f"{file}: {counted(len(raw), 'row')}, {counted(n_named, 'column')} separated by {separator!r}"]
    notes += [f"{counted(above, 'line')} above the names passed over"] if above else []
    joined = np.flatnonzero(raw.apply(lambda column: column.str.contains(r"[\r\n]", na=False)).any(axis=1))
    if joined.size:
        number = counted(joined.size, "row has values", "rows have values")
        notes.append(f"{number} of several lines, such as row {joined[0] + 1}; a quote that is not closed joins rows")
    return raw.iloc[:, :n_named].set_axis(names, axis=1), names, separator, notes


def _text(file: Path) -> str:
    try:
        content = file.read_bytes()
    except OSError as exc:
        raise TableError(f"{file}: cannot be read: {exc.strerror}") from None
    marked = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    if b"\0" in content and not marked:
        raise TableError(f"{file}: is not text; save the spreadsheet as CSV")
    for encoding in ["utf-16"] if marked else ["utf-8-sig", "cp1252", "latin-1"]:
        with suppress(UnicodeDecodeError):
            return content.decode(encoding)
    raise TableError(f"{file}: its text cannot be decoded as UTF-16; save it as CSV in UTF-8")


def _arrangement(text: str, file: Path) -> tuple[int, str, int]:
    """Lines above the names, the separator, and the most values of a row.

    Most rows have equally many values, more than one; names have as many. Of several separators, the one with the least
    above the names is right.
    """
    found, endless = [], 0
    for k, separator in enumerate(_SEPARATORS):
        reader = csv.reader(io.StringIO(text[:_LOOKED_AT], newline=""), delimiter=separator, skipinitialspace=True)
        rows, at = [], 0
        try:
            for row in reader:
                filled = [i for i, field in enumerate(row, start=1) if field.strip()]
                rows += [(at, filled[-1], len(row))] if filled else []
                at = reader.line_num
        except csv.Error:  # a value longer than Python's limit
            endless = at + 1
            continue
        usual = Counter(n for _, n, _ in rows).most_common(1)[0][0] if rows else 1
        above = next((at for at, n, _ in rows if n >= usual), 0)
        found.append((usual == 1, above, k, separator, max((n for *_, n in rows), default=1)))
    if endless and all(single for single, *_ in found):
        limit = csv.field_size_limit()
        raise TableError(f"{file}: line {endless}: a value has more than {limit} characters; is its quote not closed?")
    _, above, _, separator, width = min(found)
    return above, separator, width


def _parts(known: pd.Series) -> tuple[pd.Series, str]:
    """Numbers without blanks, and without the unit or currency that all have; minus signs stand first."""
    if _is_plain(known):
        return known, ""
    digits = known.str.replace(_BLANKS, "", regex=True).str.replace("\u2212", "-", regex=False)
    split = digits.str.extract(_PARTS)
    units = (split["currency"] + split["unit"]).dropna().unique()
    if len(units) != 1 or split["number"].notna().mean() < _LEAST_SHARE:
        return digits, ""
    minus = split["open"].notna() | (split["sign"] == "-") | (split["end"] == "-")
    return split["number"].where(~minus, "-" + split["number"]).fillna(digits), str(units[0])


def _converted(column: pd.Series, digits: pd.Series, points: str, certain: set[str], separator: str) -> pd.Series:
    """A column of text as numbers or dates if nearly all of its values are, or as it is.

    `points` are its decimal marks, and `certain` those of columns that leave no doubt.
    """
    known = column.dropna()
    if known.empty:
        return column
    if _is_plain(digits) and (points == "." or not digits.str.contains(".", regex=False).any()):
        return _finite(pd.to_numeric(digits), column)
    dates = known.str.extract(_DATE)
    if dates[0].notna().mean() >= _LEAST_SHARE:
        first, second = (pd.to_numeric(dates[k], errors="coerce") for k in (0, 2))
        year_first = first > 31
        day_first = bool((first[~year_first] > 12).any())
        month_first = bool((second[~year_first] > 12).any())
        if not (day_first and month_first):  # else nobody knows which is the month
            day_first |= not month_first and (separator == ";" or known[~year_first].str.match(r"\d+\.").all())
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of days and months in another order
                how: dict[str, Any] = {"errors": "coerce", "format": "mixed", "utc": True}
                found = pd.to_datetime(known.mask(year_first), dayfirst=day_first, **how)
                found = found.fillna(pd.to_datetime(known.where(year_first), **how))
            if found.notna().mean() >= _LEAST_SHARE:
                return found.dt.tz_localize(None).reindex(column.index)
    if not points:
        return column
    point = points[0]
    if len(points) > 1:  # as in other columns, or as is usual with the separator
        point, other = ",." if separator == ";" else ".,"
        usual = separator == "," or digits.str.contains(point, regex=False).any()
        usual |= digits.str.fullmatch(r"[-+]?\d+").any()  # with three decimals, 2 were 2,000
        point = next(iter(certain)) if len(certain) == 1 else point if usual else other
    mark = "." if point == "," else ","
    plain = digits.str.replace(mark, "", regex=False).str.replace(point, ".", regex=False)
    numbers = pd.to_numeric(plain.where(digits.str.fullmatch(_number(point))), errors="coerce")
    return _finite(numbers, column) if numbers.notna().any() else column


def _is_plain(digits: pd.Series) -> bool:
    return bool(pd.to_numeric(digits, errors="coerce").notna().all())


def _finite(numbers: pd.Series, column: pd.Series) -> pd.Series:
    return numbers.astype(float).replace([np.inf, -np.inf], np.nan).reindex(column.index)


def _number(point: str) -> str:
    """A pattern of numbers with a decimal point or comma, and perhaps the other one between thousands."""
    mark = "." if point == "," else ","
    grouped = rf"[1-9]\d{{0,2}}(\{mark}\d{{2,3}})*\{mark}\d{{3}}(\{point}\d*)?"
    return rf"[-+]?({grouped}|\d*(\{point}\d*)?([eE][-+]?\d+)?|inf)"


def _grouped(digits: pd.Series) -> pd.Series:
    """Which numbers may have a mark between thousands, or before three decimals."""
    return digits.str.fullmatch(r"[-+]?[1-9]\d{0,2}([.,]\d{3})+")


def _points(digits: pd.Series) -> str:
    """The decimal marks, of point and comma, with which nearly all are numbers, and most are."""
    few = digits[:_FEW]
    if _is_plain(digits) and not (few.str.fullmatch(r"[-+]?\d+") | _grouped(few)).all():
        return "."
    shares = {point: digits.str.fullmatch(_number(point)).mean() for point in ".,"} if len(digits) else {}
    found = "".join(p for p, share in shares.items() if share >= max(_LEAST_SHARE, *shares.values()))
    if len(found) > 1 and digits.str.fullmatch(r"[-+]?\d{4,}").any() and len(doubtful := digits[_grouped(digits)]):
        return "," if "," in doubtful.iloc[0] else "."  # 1.234 beside 1234 has no marks between thousands
    return found


def _check_columns(
    frame: pd.DataFrame, targets: list[str], group: str | None, file: str, excluded: Sequence[str]
) -> None:
    for name in (*targets, *([] if group is None else [group]), *excluded):
        if name not in frame:
            raise TableError(f"{file}: has no column {name!r}; its columns are {', '.join(map(repr, frame.columns))}")
    parts = [*targets, *([] if group is None else [group]), *set(excluded)]
    if len(set(parts)) < len(parts):
        left = f", left out {listed(excluded)}" if excluded else ""
        raise TableError(f"{file}: a column has one part, got targets {targets} and group {group!r}{left}")
    for name in targets:
        if frame[name].dtype.kind != "f":
            values = frame[name].dropna()
            shown = repr(str(values.iloc[0])) if len(values) else "none at all"
            raise TableError(f"{file}: target {name!r} must hold numbers, found {shown}")


def choose_columns(
    frame: pd.DataFrame, targets: list[str], group: str | None, file: str, excluded: Sequence[str] = ()
) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """Inputs and targets of the rows that have all targets, and what is used and left out, as lines."""
    _check_columns(frame, targets, group, file, excluded)
    whole = frame[[*targets, *([] if group is None else [group])]].notna().all(axis=1)
    gaps, notes, used, left_out = np.flatnonzero(~whole), [], [], []
    rows = frame[whole]
    if len(rows) < _FEWEST_ROWS:
        raise TableError(f"{file}: {counted(len(rows), 'row')} with all targets, at least {_FEWEST_ROWS} are needed")
    for name in frame.columns.difference(targets, sort=False):
        why = "excluded" if name in excluded else "" if name == group else _useless(frame[name])
        missing = rows[name].isna().mean()
        if why:
            left_out.append(f"{name} ({why})")
        else:
            used.append(name)
            words = {"M": ["date"], "f": []}.get(rows[name].dtype.kind, [f"text, {rows[name].nunique()} labels"])
            words += [f"{missing:.0%} missing"] if missing else []
            notes.append(f"{name} ({', '.join(words)})" if words else name)
    if not used:
        raise TableError(f"{file}: no column is left to learn from; {'; '.join(left_out) or 'all are targets'}")
    lines = [
        f"target: {listed(targets)}" + (f"; groups: {group}" if group else ""),
        f"used: {', '.join(notes[:_NAMED])}",
    ]
    lines[1] += f" and {len(notes) - _NAMED} more" if len(notes) > _NAMED else ""
    if left_out:
        lines.append(f"left out: {', '.join(left_out)}")
    if gaps.size:
        first = ", ".join(map(str, (gaps[:5] + 1).tolist())) + (", ..." if gaps.size > 5 else "")
        lines.append(f"left out: {counted(gaps.size, 'row')} without a target or group (rows {first})")
    inputs = rows[used]
    if group is not None and inputs[group].dtype.kind == "f" and (inputs[group] % 1 == 0).all():
        inputs = inputs.astype({group: int})  # group 2, not 2.0
    return inputs, rows[targets], lines


def _useless(column: pd.Series) -> str:
    """Why a column is left out, or nothing."""
    known, missing = column.dropna(), column.isna().mean()
    if missing > _MOST_MISSING:
        return f"{missing:.0%} missing"
    if known.nunique() < 2:
        return "one value only"
    if column.dtype.kind == "f":
        return "numbers the rows" if len(known) > 2 and (known.diff().iloc[1:] == 1).all() else ""
    if column.dtype.kind != "M" and known.nunique() > _MOST_DISTINCT * len(known):
        return "another text in nearly every row"
    return ""
