"""``conformodal table``: regions and their coverage from a CSV file as a spreadsheet writes it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from conformodal.conformal import ConformalRegressor, Diagnosis, PredictiveDensity, Regions
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.saving import check_replaceable
from conformodal.core.extras import require_extra
from conformodal.core.files import replacing
from conformodal.core.words import counted, listed

from .console import report_line, warning_lines
from .failures import report_errors
from .table_csv import CsvFormat, TableError, read_table

_FEWEST_ROWS = 50  # a fifth is tested, and a fifth of the rest calibrates
_SHOWN, _NAMED = 3, 20  # rows, columns
_MOST_MISSING, _MOST_DISTINCT = 0.5, 0.9
_PICTURES = (".svg", ".png", ".pdf")
_READING = "How the file is written"


@report_errors()
def table(
    file: Annotated[Path, typer.Argument(help="CSV file with a line of column names.")],
    target: Annotated[list[str], typer.Option(help="Column to predict; repeat it for several, covered together.")],
    group: Annotated[
        list[str] | None, typer.Option(help="Column whose values are groups: coverage is guaranteed in each.")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option(help="Column to leave out, such as one known after the target; repeatable.")
    ] = None,
    sep: Annotated[str | None, typer.Option(help="Separator; recognised by default.", rich_help_panel=_READING)] = None,
    decimal: Annotated[
        str | None, typer.Option(help="Mark before decimals; recognised by default.", rich_help_panel=_READING)
    ] = None,
    thousands: Annotated[
        str | None, typer.Option(help="Mark between thousands; none by default.", rich_help_panel=_READING)
    ] = None,
    na_values: Annotated[
        list[str] | None, typer.Option(help="Text that means a missing value; repeatable.", rich_help_panel=_READING)
    ] = None,
    alpha: Annotated[str, typer.Option(help="Miscoverage rate.")] = "0.1",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the split and of the learner.")] = 0,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of sets and coverage, .svg, .png or .pdf; needs the extra 'figures'.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="File for the fitted regressor, for ConformalRegressor.load; extra 'save'.")
    ] = None,
) -> None:
    """Learn columns of a CSV file from the others; print regions of unseen rows and their coverage."""
    as_alpha(alpha)
    _check_outputs(plot, model)
    written = CsvFormat("\t" if sep == r"\t" else sep, decimal, thousands, na_values or ())
    frame, notes = read_table(file, written)
    if len(group or []) > 1:
        raise TableError(f"--group names one column, got {listed(group or [])}; ConditionalConformal takes several")
    by = group[0] if group else None
    X, y, more = choose_columns(frame, target, by, str(file), exclude or [])
    for note in (*notes, *more):
        report_line(note)
    test, train = np.split(np.random.default_rng(seed).permutation(len(X)), [len(X) // 5])
    joint: Any = "max" if len(target) > 1 else "none"
    reg = ConformalRegressor(alpha=alpha, joint=joint, random_state=seed)
    groups = {part: X[by].iloc[rows] if by else None for part, rows in (("train", train), ("test", test))}
    with warning_lines(UserWarning, lambda text: report_line(f"note: {text}")):
        reg.fit(X.iloc[train], y.iloc[train], groups=groups["train"])
    regions = reg.predict_region(X.iloc[test], groups=groups["test"])
    for row in sorted({*range(_SHOWN), int((regions.n_intervals > 1).any(axis=1).argmax())}):
        for name, parts in zip(target, regions.intervals(row), strict=True):
            ranges = " or ".join(f"{low:.4g} to {high:.4g}" for low, high in parts) or "no value"
            true = y[name].iloc[test[row]]
            report_line(f"row {X.index[test[row]] + 1}, {name}: {ranges} (true: {true:.4g})")
    several = (regions.n_intervals > 1).any(axis=1).mean()
    report_line(f"rows with several intervals: {several:.0%}")
    diagnosis = reg.diagnose(X.iloc[test], y.iloc[test], groups["test"])
    for line in str(diagnosis).splitlines():
        report_line(line)
    if model is not None:
        reg.save(model)
        report_line(f"regressor: {model.resolve()}")
    if plot is not None:
        _draw(reg.predict_density(X.iloc[test]), regions, y.iloc[test], diagnosis, plot)


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


def _draw(density: PredictiveDensity, regions: Regions, y: pd.DataFrame, diagnosis: Diagnosis, plot: Path) -> None:
    """Draw sets and density of every target over the rows, from the smallest predicted mean on, beside the coverage."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    from conformodal.report.tables import draw_coverage, draw_regions  # noqa: PLC0415

    n_targets = y.shape[1]
    figure = Figure(figsize=(12, 4 * n_targets), layout="constrained")
    grid = figure.subplots(n_targets, 2, squeeze=False, width_ratios=(3, 2))
    for j, (left, right) in enumerate(grid):
        rank = density.mean[:, j].argsort(kind="stable").argsort()
        draw_regions(regions, y, pd.Series(rank, name="unseen rows, by predicted mean"), density, j, left)
        if j < len(diagnosis.columns):
            draw_coverage(diagnosis, j, right)
        else:
            right.set_axis_off()
    with replacing(plot) as part:
        figure.savefig(part, format=plot.suffix[1:], metadata={"Creator": "conformodal"})
    report_line(f"picture: {plot.resolve()}")


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
            raise TableError(f"{file}: target {name!r} must hold numbers, got {shown}; see --decimal and --thousands")


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
