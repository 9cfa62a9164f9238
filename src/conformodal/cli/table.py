"""``conformodal table``: regions and their coverage from a CSV file as a spreadsheet writes it, and of new files."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from difflib import get_close_matches
from enum import StrEnum
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from conformodal.conformal import ConformalRegressor, Diagnosis, PredictiveDensity, Regions, diagnose
from conformodal.conformal.checks import doubt_alpha
from conformodal.conformal.density.encoder import as_column, varying_parts
from conformodal.conformal.saving import check_replaceable
from conformodal.core.arrays import AnyArray, evenly_spread
from conformodal.core.extras import require_extra
from conformodal.core.files import check_writable_file
from conformodal.core.words import counted, listed, readable

from .console import OUTPUT_PANEL, AsJson, Group, Quiet, print_json, report_line, warning_lines
from .table_csv import TableError, read_table
from .table_options import DateFormats, DecimalMark, NaValues, Separator, ThousandsMark
from .table_predict import named_format, predict, region_columns

_FEWEST_ROWS = 50  # a fifth is tested, and a fifth of the rest calibrates
_SHOWN, _NAMED, _MAX_DRAWN = 3, 20, 200  # rows, columns, rows of a picture
_MAX_MISSING, _MAX_DISTINCT = 0.5, 0.9
_OUTLYING, _FEW_TOTALS = 10, 0.02  # medians that a sum exceeds, share of rows that may be totals by their labels
_MAX_SOLVED, _ROWS_SOLVED, _TINY = 100, 1000, 1e-6  # columns and rows of an equation for the target; its error
_PICTURES = (".svg", ".png", ".pdf")
_INDEX = r"column 1|index|Unnamed: \d+"  # the first of them stands for no name
_TOTAL = (
    r"(?i)(grand |sub|sub-)?totals?|(grand )?total .*|sums?|summe|gesamt|insgesamt|somme|totale|suma|average|mean|Σ"
)
_data, _output = (partial(typer.Option, rich_help_panel=panel) for panel in ("Rows and regions", OUTPUT_PANEL))


class _FitByDefault(Group):
    """``table FILE`` is ``table fit FILE``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``fit`` before arguments that begin with an option or a file."""
        first = args[0] if args else "--help"
        if first not in (*self.commands, "--help") and (not first.isalpha() or Path(first).exists()):
            args = ["fit", *args]
        return super().parse_args(ctx, args)


_HELP = "Learn columns of a CSV file from the others (fit, the default), or write regions of new rows (predict)."
app = typer.Typer(cls=_FitByDefault, help=_HELP, no_args_is_help=True, add_completion=False)


class RowSplit(StrEnum):
    """Which rows test and calibrate."""

    RANDOM = "random"
    TIME = "time"


@app.command()
def fit(
    file: Annotated[Path, typer.Argument(help="CSV file with a line of column names, or a Parquet file.")],
    target: Annotated[list[str], _data(help="Column to predict; repeat it for several, covered together.")],
    group: Annotated[str | None, _data(help="Column of groups; coverage is guaranteed in each.")] = None,
    exclude: Annotated[
        list[str] | None, _data(help="Column to leave out, such as one known later; repeatable.")
    ] = None,
    unit: Annotated[str | None, _data(help="Column that names what rows belong to, such as a subject.")] = None,
    split: Annotated[
        RowSplit, _data(help="Rows that test and calibrate: at random, or the last in time.")
    ] = RowSplit.RANDOM,
    sep: Separator = None,
    decimal: DecimalMark = None,
    thousands: ThousandsMark = None,
    na_values: NaValues = None,
    date: DateFormats = None,
    alpha: Annotated[str, _data(help="Miscoverage rate.")] = "0.1",
    y_min: Annotated[float, _data("--min", help="Value that no target falls below, such as 0.")] = -np.inf,
    y_max: Annotated[float, _data("--max", help="Value that no target exceeds.")] = np.inf,
    seed: Annotated[int, _data(min=0, help="Seed of the split and of the learner.")] = 0,
    plot: Annotated[Path | None, _output(help="Picture (.svg, .png, .pdf); needs the extra 'figures'.")] = None,
    model: Annotated[
        Path | None, _output(help="File of the regressor, for 'table predict'; needs the extra 'save'.")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Learn columns of a CSV file from the others; print regions of unseen rows and their coverage."""
    if question := doubt_alpha(alpha):
        raise TableError(question)
    _check_outputs(plot, model, target)
    if unit is not None and (group or split is RowSplit.TIME):
        raise TableError("--unit cannot be used with --group or --split time")
    named = named_format(sep, decimal, thousands, na_values, date)
    frame, notes = read_table(file, named)
    left_out = [name for given in exclude or () for name in ([given] if given in frame else given.split(","))]
    left_out += [] if unit is None else [unit]
    X, y, more = choose_columns(frame, target, group, str(file), left_out)
    for note in (*notes, *more, *doubt_targets(X, y, y_min)):
        report_line(note)
    units = None if unit is None else frame[unit].loc[X.index].astype(str)
    test, train = _split_rows(X, units, split, np.random.default_rng(seed))
    joint: Any = "max" if len(target) > 1 else "none"
    reg = ConformalRegressor(alpha=alpha, joint=joint, random_state=seed, y_min=y_min, y_max=y_max)
    reg.calibration = "random" if split is RowSplit.RANDOM else "last"
    train_groups, test_groups = (X[group].iloc[rows] if group else None for rows in (train, test))
    with _warnings_as_notes():
        reg.fit(X.iloc[train], y.iloc[train], groups=train_groups, units=None if units is None else units.iloc[train])
        unlike = reg.compare_rows(X.iloc[test])
        proba = reg.proba_of(X.iloc[test])
        regions = reg.regions_of(proba, unlike, None, test_groups)
    several = (regions.n_intervals > 1).any(axis=1)
    for row in sorted({*range(_SHOWN), int(several.argmax())}):
        for name, parts in zip(target, regions.intervals(row), strict=True):
            ranges = " or ".join(f"{readable(low)} to {readable(high)}" for low, high in parts) or "no value"
            true = y[name].iloc[test[row]]
            report_line(f"line {X.index[test[row]]}, {name}: {ranges} (true: {readable(true)})")
    report_line(f"rows with several intervals: {several.sum()} of {len(test)}")
    about = f"rows of any new {unit}" if unit else "rows drawn at random"
    if split is RowSplit.TIME:
        about = "the last rows, calibrated on those before; no split guarantees that of later ones"
    elif X.select_dtypes("datetime").shape[1]:
        about += "; for that of the last rows in time: --split time"
    report_line(f"coverage below is that of {about}")
    diagnosis = diagnose(reg.calibrator_, proba, y.iloc[test].to_numpy(), test_groups, regions=regions)
    for line in str(diagnosis).splitlines():
        report_line(line)
    if split is RowSplit.TIME and any(
        check.coverage < check.low for one in diagnosis.columns for _, check in one.rows()
    ):
        report_line("the data seem to drift: the last rows are covered less often than chance allows", bold=True)
    if model is not None:
        others, form = frame.drop(columns=[*X, *y]), frame.attrs["format"]
        reg.file_format_ = {
            "identifiers": [str(name) for name in others if others[name].nunique() > 1],
            "csv": {name: getattr(named, name) for name in ("decimal", "thousands", "na_values", "dates")}
            | {name: form[name] for name in ("kinds", "missing")},
            "units": form["units"],
        }
        reg.save(model)
        report_line(f"regressor: {model.resolve()}")
    if plot is not None:
        with _warnings_as_notes():  # such as of letters that the font lacks
            _draw(PredictiveDensity(reg.bins_, proba), regions, y.iloc[test], diagnosis, plot)
    print_json(json.loads(json.dumps(asdict(diagnosis)), parse_constant=lambda _: None))  # infinite sizes


def _warnings_as_notes() -> AbstractContextManager[None]:
    return warning_lines(UserWarning, lambda text: report_line(f"note: {text}", bold=True))


app.command()(predict)


def _split_rows(
    X: pd.DataFrame, units: pd.Series | None, split: RowSplit, random: np.random.Generator
) -> tuple[AnyArray, AnyArray]:
    """Positions of a fifth of the rows, to test on, and of the others: whole units, or the last in time."""
    if split is RowSplit.TIME:
        order, dates = np.arange(len(X)), X.select_dtypes("datetime")
        if dates.shape[1]:
            times = dates.iloc[:, 0].to_numpy()
            order = np.lexsort((times, ~np.isnat(times)))  # rows without a date are the first, which are learnt from
            if n_undated := int(np.isnat(times).sum()):
                report_line(f"note: {counted(n_undated, 'row')} without {dates.columns[0]} taken as the first in time")
        return order[len(X) - len(X) // 5 :], order[: len(X) - len(X) // 5]
    if units is None:
        test, train = np.split(random.permutation(len(X)), [len(X) // 5])
        return test, train
    names = random.permutation(units.unique())
    held = units.isin(names[: -(-len(names) // 5)]).to_numpy()
    return random.permutation(np.flatnonzero(held)), np.flatnonzero(~held)


def _check_outputs(plot: Path | None, model: Path | None, targets: list[str]) -> None:
    """Refuse to write over what this command has not written, and without the extras, before any work begins."""
    if plot is not None:
        ours = not plot.exists() or (plot.is_file() and b"conformodal" in plot.read_bytes())
        if plot.suffix not in _PICTURES or not ours:
            raise TableError(f"{plot}: must be new, or a picture of this command, with {', '.join(_PICTURES)}")
        with require_extra("figures", "--plot"):
            import_module("matplotlib")
    if model is not None:
        check_replaceable(model)
        region_columns(targets)
        with require_extra("save", "--model"):
            import_module("skops")
    for path in filter(None, (plot, model)):
        check_writable_file(path)


def _draw(density: PredictiveDensity, regions: Regions, y: pd.DataFrame, diagnosis: Diagnosis, plot: Path) -> None:
    """Draw sets and density of every target over the rows, from the smallest predicted mean on, beside the coverage."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    from conformodal.report.tables import coverage_height, draw_coverage, draw_regions, save_picture  # noqa: PLC0415

    n_targets = y.shape[1]
    height = max(4.0, coverage_height(diagnosis))
    figure = Figure(figsize=(12, height * n_targets), layout="constrained")
    grid = figure.subplots(n_targets, 2, squeeze=False, width_ratios=(3, 2))
    for j, (left, right) in enumerate(grid):
        rows = density.mean[:, j].argsort(kind="stable")[evenly_spread(len(y), _MAX_DRAWN)]
        some = PredictiveDensity(density.bins, [part[rows] for part in density.proba])
        place = pd.Series(np.arange(len(rows)), name=f"{len(rows):,} of {len(y):,} unseen rows, by predicted mean")
        draw_regions(regions[rows], y.iloc[rows], place, some, j, left)
        title = f"{y.columns[j]}: sets, alpha = {diagnosis.alpha}"
        left.set_title(title, fontsize="medium", loc="left", pad=24, parse_math=False)
        if j < len(diagnosis.columns):
            draw_coverage(diagnosis, j, right)
        else:
            right.set_axis_off()
    save_picture(figure, plot)
    report_line(f"picture: {plot.resolve()}")


def choose_columns(
    frame: pd.DataFrame, targets: list[str], group: str | None, file: str, excluded: Sequence[str] = ()
) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """Inputs and targets of the rows that have all targets, and what is used and left out, as lines."""
    needed = [*targets, *([] if group is None else [group])]
    for name in (*needed, *excluded):
        if name not in frame:
            close = get_close_matches(name, frame.columns, 1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            raise TableError(f"{file}: has no column {name!r}{hint}; it has {', '.join(map(repr, frame.columns))}")
        if [*needed, *excluded].count(name) > 1:
            raise TableError(f"{file}: column {name!r} can only be one of target, group and excluded")
    check_targets(frame, targets, file)
    totals = total_rows(frame)
    whole = frame[needed].notna().all(axis=1) & ~totals
    gaps, used, left_out, rows = np.flatnonzero(~whole & ~totals), list[str](), [], frame[whole]
    if len(rows) < _FEWEST_ROWS:
        raise TableError(f"{file}: {counted(len(rows), 'row')} with all targets, at least {_FEWEST_ROWS} are needed")
    for name, column in frame.drop(columns=targets).items():
        why = "excluded" if name in excluded else "" if name == group else _useless(column)
        if why:
            left_out.append(f"{name} ({why})")
        else:
            used.append(name)
    if not used:
        raise TableError(f"{file}: no column is left to learn from; {'; '.join(left_out) or 'all are targets'}")
    more = f" and {len(used) - _NAMED} more" if len(used) > _NAMED else ""
    lines = [
        f"target: {listed(targets)}" + (f"; groups: {group}" if group else ""),
        f"used: {', '.join(_describe_column(rows[name]) for name in used[:_NAMED])}{more}",
    ]
    lines += [f"left out: {', '.join(left_out)}"] if left_out else []
    if gaps.size:
        at = _few_lines(frame.index[gaps])
        lines.append(f"left out: {counted(gaps.size, 'row')} without a target or group (lines {at})")
    if totals.any():
        at = _few_lines(frame.index[totals])
        lines.append(f"note: left out: {counted(int(totals.sum()), 'row')} with totals of the others (lines {at})")
    lines += _doubt_labels(rows)
    inputs = rows[used]
    if group is not None and inputs[group].dtype.kind == "f" and (inputs[group] % 1 == 0).all():
        inputs = inputs.astype({group: int})  # group 2, not 2.0
    return inputs, rows[targets], lines


def check_targets(frame: pd.DataFrame, targets: list[str], file: str) -> None:
    """Refuse targets that hold other than numbers, or numbers that are not clear."""
    unfit = frame.attrs.get("format", {}).get("unfit", {})
    for name in targets:
        if why := unfit.get(name):
            raise TableError(f"{file}: target {name!r} {why}; write numbers in one unit, or leave them out")
        values = frame[name].dropna()
        if values.empty:
            raise TableError(f"{file}: target {name!r} holds no values")
        if values.dtype.kind != "f":
            value = str(values.iloc[0])
            raise TableError(f"{file}: target {name!r} must hold numbers, got {value!r}; see --decimal and --thousands")


def total_rows(frame: pd.DataFrame) -> pd.Series:
    """Rows that hold the sums of the others, or end the file with a label of totals that no other row has.

    One sum may be chance, as of the only other value than 0, so there must be two, or one beside such a label.
    """
    numbers = frame.select_dtypes("float")
    with np.errstate(over="ignore"):
        halves = numbers.sum() / 2  # infinite where numbers overflow, which none equals
        sums = np.isclose(numbers, halves, rtol=1e-6, atol=0) & (numbers.abs() > _OUTLYING * numbers.abs().median())
    called = pd.Series(False, frame.index)
    for _, column in _text_columns(frame).items():
        called |= _called_total(column) & ~column.duplicated(keep=False)
    n_sums, n_numbers = sums.sum(axis=1), numbers.notna().sum(axis=1)
    at_end = called[::-1].cummin()[::-1]
    return at_end | ((n_sums > n_numbers / 2) & ((n_sums > 1) | called))


def _text_columns(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.select_dtypes(exclude=["float", "datetime"])


def _called_total(column: pd.Series) -> pd.Series:
    return column.isin([label for label in column.dropna().unique() if re.fullmatch(_TOTAL, str(label))])


def _doubt_labels(rows: pd.DataFrame) -> list[str]:
    """Notes on the few rows of a table that may be totals by their labels, and are learnt from."""
    notes = []
    for name, column in _text_columns(rows).items():
        called = column[_called_total(column)]
        if 0 < len(called) < _FEW_TOTALS * len(rows):
            which = f"{counted(len(called), 'row')} with {called.iloc[0]!r} (lines {_few_lines(called.index)})"
            notes.append(f"note: {name}: {which} used; remove them if they are totals of others")
    return notes


def _few_lines(lines: pd.Index) -> str:
    return ", ".join(map(str, lines[:5])) + (", ..." if len(lines) > 5 else "")


def doubt_targets(X: pd.DataFrame, y: pd.DataFrame, y_min: float) -> list[str]:
    """Notes on targets that are never negative, whole, or a linear function of other columns."""
    notes = []
    numbers = X.select_dtypes("float").dropna(axis=1).iloc[:, :_MAX_SOLVED].head(_ROWS_SOLVED)
    for name, values in y.items():
        if y_min < 0 <= values.min():
            notes.append(f"note: {name} is never negative; if it cannot be, give --min 0")
        if (values % 1 == 0).all():
            notes.append(f"note: {name} holds whole numbers only; an interval stands for those in it")
        if 2 * numbers.shape[1] >= len(numbers):
            continue
        inputs, target = numbers.to_numpy(), values.loc[numbers.index].to_numpy()
        factors = np.linalg.lstsq(inputs, target, rcond=None)[0]
        used = np.abs(factors) * np.abs(inputs).max(axis=0) > _TINY * np.abs(target).max()
        if used.any() and np.allclose(inputs @ factors, target, rtol=_TINY, atol=_TINY * np.abs(target).max()):
            terms = listed([*map(str, numbers.columns[used])])
            what = f"the sum of {terms}" if np.allclose(factors[used], 1) else f"a linear function of {terms}"
            notes.append(f"note: {name} equals {what}; --exclude what is known only with it")
    return notes


def _describe_column(column: pd.Series) -> str:
    """A column that is used: its name, what it holds unless these are numbers, and how much of it is missing."""
    if column.dtype.kind == "M":
        words = [f"date: {listed(varying_parts(as_column(column, column.name)) or ['date'])}"]
    else:
        words = [] if column.dtype.kind == "f" else [f"text, {column.nunique()} labels"]
    words += [f"{column.isna().mean():.0%} missing"] if column.hasnans else []
    return f"{column.name} ({', '.join(words)})" if words else str(column.name)


def _useless(column: pd.Series) -> str:
    """Why a column is left out, or nothing."""
    if re.fullmatch(_INDEX, str(column.name)) and column.dtype.kind == "f" and (column.dropna() % 1 == 0).all():
        return "an index"
    gaps = pd.isna(column.to_numpy())  # of NumPy: there may be thousands of columns
    values, missing = column.to_numpy()[~gaps], gaps.mean()
    if missing > _MAX_MISSING:
        return f"{missing:.0%} missing"
    if (values == values[:1]).all():
        return "one value only"
    if column.dtype.kind == "f":
        return "numbers the rows" if len(values) > 2 and (np.diff(values) == 1).all() else ""
    if column.dtype.kind != "M" and column.nunique() > _MAX_DISTINCT * len(values):
        return "another text in nearly every row"
    return ""
