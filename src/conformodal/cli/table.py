"""``conformodal table``: regions and their coverage from a CSV file as a spreadsheet writes it."""

from __future__ import annotations

import csv
import io
import warnings
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from conformodal.conformal import ConformalRegressor, ConformodalError, Diagnosis
from conformodal.conformal.learning.saving import check_replaceable
from conformodal.core.files import replacing
from conformodal.core.words import counted, listed

from .console import report_errors, report_line

_FEWEST_ROWS = 50  # a fifth is tested, and a fifth of the rest calibrates
_SHOWN = 3
_LEAST_SHARE = 0.95  # of a column's values that must be numbers, or dates, for it to hold them
_MOST_MISSING, _MOST_DISTINCT = 0.5, 0.9
_PICTURES = (".svg", ".png", ".pdf")
_DATE = r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}"


class TableError(ConformodalError):
    """A file that is not a table, or lacks what is asked for."""


@report_errors
def table(
    file: Annotated[Path, typer.Argument(help="CSV file with a line of column names.")],
    target: Annotated[list[str], typer.Option(help="Column to predict; repeat it for several, covered together.")],
    group: Annotated[
        str | None, typer.Option(help="Column whose values are groups: coverage is guaranteed in each.")
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
    X, y, more = choose_columns(frame, target, group, str(file))
    for note in (*notes, *more):
        report_line(note)
    test, train = np.split(np.random.default_rng(seed).permutation(len(X)), [len(X) // 5])
    joint: Any = "max" if len(target) > 1 else "none"
    reg = ConformalRegressor(alpha=alpha, joint=joint, random_state=seed, groups=group, verbose=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        reg.fit(X.iloc[train], y.iloc[train])
    for warning in caught:
        report_line(f"note: {warning.message}")
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
    if plot is not None:
        _draw(reg, X.iloc[test], y.iloc[test], found, plot)
    if model is not None:
        reg.save(model)
        report_line(f"regressor: {model.resolve()}")


def _check_outputs(plot: Path | None, model: Path | None) -> None:
    """Refuse to write over what this command has not written, before any work begins."""
    if plot is not None and plot.suffix not in _PICTURES:
        raise TableError(f"{plot}: the name of a picture ends with {', '.join(_PICTURES)}")
    if plot is not None and plot.exists() and not (plot.is_file() and b"conformodal" in plot.read_bytes()):
        raise TableError(f"{plot}: exists and is not a picture of this command, not replaced; name another file")
    if model is not None:
        check_replaceable(model)


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

    Commas, semicolons, tabs or bars separate; numbers may have decimal commas; UTF-8, UTF-16 and the encoding of
    Western Windows are read. A column holds numbers or dates if 95 % of its values are; the others are then missing.
    """
    try:
        content = file.read_bytes()
    except OSError as exc:
        raise TableError(f"{file}: cannot be read: {exc.strerror}") from None
    encodings = ["utf-16"] if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ["utf-8-sig", "cp1252", "latin-1"]
    for encoding in encodings:
        try:
            text = content.decode(encoding)
            break
        except UnicodeDecodeError:
            continue
    else:
        raise TableError(f"{file}: its text cannot be decoded as UTF-16; save it as CSV in UTF-8")
    if "\0" in text:
        raise TableError(f"{file}: is not text; save the spreadsheet as CSV")
    lines = text.lstrip().splitlines()[:1] or [""]
    separator = max(";\t,|", key=lambda s: len(next(csv.reader(lines, delimiter=s), [])))
    try:
        raw = pd.read_csv(io.StringIO(text), sep=separator, dtype=str, skipinitialspace=True, index_col=False)
    except (ValueError, pd.errors.ParserError) as exc:
        raise TableError(f"{file}: cannot be read as CSV: {' '.join(str(exc).split())}") from None
    notes = [f"{file}: {counted(len(raw), 'row')}, {counted(raw.shape[1], 'column')} separated by {separator!r}"]
    columns = {}
    for j, name in enumerate(raw.columns):
        column = raw.iloc[:, j].str.strip().replace("", None)
        columns[str(name).strip()] = found = _converted(column, separator)
        lost = column[found.isna() & column.notna()]
        if len(lost):
            notes.append(f"{name}: {counted(len(lost), 'value')} taken as missing, such as {lost.iloc[0]!r}")
    return pd.DataFrame(columns), notes


def _converted(column: pd.Series, separator: str) -> pd.Series:
    """A column of text as numbers or dates if nearly all of its values are, or as it is."""
    known = column.dropna()
    if known.empty:
        return column
    plain = pd.to_numeric(known, errors="coerce")
    if plain.notna().mean() < _LEAST_SHARE and known.str.match(_DATE).mean() >= _LEAST_SHARE:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of days and months in another order
            dates = pd.to_datetime(known, errors="coerce", format="mixed", dayfirst=separator == ";", utc=True)
        if dates.notna().mean() >= _LEAST_SHARE:
            return dates.dt.tz_localize(None).reindex(column.index)
    if plain.notna().mean() < _LEAST_SHARE:
        plain = _with_commas(known.str.replace(r"[\s']", "", regex=True), separator)
    return plain.reindex(column.index).astype(float) if plain.notna().mean() >= _LEAST_SHARE else column


def _with_commas(digits: pd.Series, separator: str) -> pd.Series:
    """Numbers with a decimal comma and points between thousands, or the other way round; NaN for what is neither."""
    both = digits[digits.str.contains(",", regex=False) & digits.str.contains(".", regex=False)]
    if len(both):
        comma = bool((both.str.rfind(",") > both.str.rfind(".")).all())
    else:  # 1,234 in a file with commas between its columns is a thousand and more
        comma = separator != "," or not digits.str.fullmatch(r"-?\d{1,3}(,\d{3})*").all()
    mark, point = (".", ",") if comma else (",", ".")
    number = rf"[-+]?(\d{{1,3}}(\{mark}\d{{3}})+|\d+)(\{point}\d*)?([eE][-+]?\d+)?"
    plain = digits.str.replace(mark, "", regex=False).str.replace(point, ".", regex=False)
    return pd.to_numeric(plain.where(digits.str.fullmatch(number)), errors="coerce")


def choose_columns(
    frame: pd.DataFrame, targets: list[str], group: str | None, file: str
) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """Inputs and targets of the rows that have all targets, and what is used and left out, as lines."""
    for name in (*targets, *([] if group is None else [group])):
        if name not in frame:
            raise TableError(f"{file}: has no column {name!r}; its columns are {', '.join(map(repr, frame.columns))}")
    if group in targets or len(set(targets)) < len(targets):
        raise TableError(f"{file}: a column has one part, got targets {targets} and group {group!r}")
    for name in targets:
        if frame[name].dtype.kind != "f":
            values = frame[name].dropna()
            shown = repr(str(values.iloc[0])) if len(values) else "none at all"
            raise TableError(f"{file}: target {name!r} must hold numbers, found {shown}")
    whole = frame[[*targets, *([] if group is None else [group])]].notna().all(axis=1)
    gaps, notes, used, left_out = np.flatnonzero(~whole), [], [], []
    rows = frame[whole]
    if len(rows) < _FEWEST_ROWS:
        raise TableError(f"{file}: {counted(len(rows), 'row')} with all targets, at least {_FEWEST_ROWS} are needed")
    for name in frame.columns.difference(targets, sort=False):
        why = "" if name == group else _useless(frame[name])
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
    lines = [f"target: {listed(targets)}" + (f"; groups: {group}" if group else ""), f"used: {', '.join(notes)}"]
    if left_out:
        lines.append(f"left out: {', '.join(left_out)}")
    if gaps.size:
        first = ", ".join(map(str, (gaps[:5] + 1).tolist())) + (", ..." if gaps.size > 5 else "")
        lines.append(f"left out: {counted(gaps.size, 'row')} without a target or group (rows {first})")
    return rows[used], rows[targets], lines


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
