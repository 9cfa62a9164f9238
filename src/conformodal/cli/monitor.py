"""``conformodal monitor``: a bet against the exchangeability of new recordings, or rows, with those that calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.conformal import ExchangeabilityMartingale
from conformodal.core.words import counted, readable

from .console import AsJson, OptionError, Quiet, print_json, report_line
from .monitored import MonitoredScores
from .table_options import DateFormats, DecimalMark, NaValues, Separator, ThousandsMark


def monitor(
    model: Annotated[Path, typer.Argument(help="Folder of a pose model, or file of a regressor.")],
    results: Annotated[
        list[Path], typer.Argument(help="Folders that run wrote with this model, or CSV files; the oldest first.")
    ],
    level: Annotated[float, typer.Option(help="Probability of a false alarm, ever.")] = 0.01,
    unit: Annotated[str | None, typer.Option(help="Column of a table that names what rows belong to.")] = None,
    sep: Separator = None,
    decimal: DecimalMark = None,
    thousands: ThousandsMark = None,
    na_values: NaValues = None,
    date: DateFormats = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed that breaks ties.")] = 0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Test whether new recordings, or rows, are like those that calibrate; exit code 1 is an alarm.

    With true poses (or targets) it tests what coverage rests on; runs without true poses are tested for novelty. CSV
    files are read as the one learnt from, except for what is named here.
    """
    named: dict[str, Any] = {
        "sep": sep,
        "decimal": decimal,
        "thousands": thousands,
        "na_values": na_values,
        "date": date,
    }
    if model.is_dir():
        if given := [f"--{k.replace('_', '-')}" for k, v in {"unit": unit, **named}.items() if v]:
            raise OptionError(f"{', '.join(given)}: for tables, and the model is a folder")
        from .monitor_runs import scores_of_runs  # noqa: PLC0415 - tables need nothing of cameras

        scores = scores_of_runs(model, results, seed)
    else:
        from .monitor_tables import scores_of_tables  # noqa: PLC0415
        from .table_predict import named_format  # noqa: PLC0415

        scores = scores_of_tables(model, results, unit, named_format(**named))
    record = _watch(scores, level, seed)
    print_json(record)
    if record["alarm"] is not None:
        raise typer.Exit(1)


def _watch(scores: MonitoredScores, level: float, seed: int) -> dict[str, Any]:
    """Bet on the scores, each column at its share of the level, and report what came of it."""
    martingales = []
    for before, new in zip(scores.before.T, scores.new.T, strict=True):
        share = level / len(scores.columns)
        one = ExchangeabilityMartingale(before, scores.groups, share, larger_only=scores.larger_only, seed=seed)
        martingales.append(one.update(new, scores.new_groups))
    n, n_before = len(scores.new), len(scores.before)
    report_line(
        f"tested: {scores.quantity} of {counted(n, scores.noun, scores.plural)}, after {n_before} that calibrate"
    )
    first = min((one for one in martingales if one.alarm_ is not None), key=lambda one: one.alarm_ or 0, default=None)
    for name, one in zip(scores.columns, martingales, strict=True):
        of = f" of {name}" if len(martingales) > 1 else ""
        report_line(
            f"evidence{of}: {readable(float(one.values_[-1]))} now, {readable(float(one.values_.max()))} at most "
            f"(alarm from {readable(len(martingales) / level)} on)"
        )
    alarm = None
    if first is None or first.alarm_ is None:
        report_line(f"no alarm: nothing speaks against new {scores.plural} like those that calibrate")
    else:
        alarm = {"unit": scores.names[first.alarm_], "index": first.alarm_, "larger": first.larger_}
        what = "larger: regions miss too much" if first.larger_ else "smaller: regions are wider than needed"
        told = f"{scores.quantity} are {what}" if scores.quantity.startswith("scores") else "images are of other places"
        report_line(f"alarm at {alarm['unit']}: {told}. Train again with recent data", bold=True)
    for limit in scores.limits:
        report_line(limit)
    return {
        "command": "monitor",
        "tested": scores.quantity,
        "unit": scores.noun,
        "n_before": n_before,
        "n_new": n,
        "level": level,
        "seed": seed,
        "alarm": alarm,
        "units": scores.names,
        "p_values": {k: one.p_values_.tolist() for k, one in zip(scores.columns, martingales, strict=True)},
        "evidence": {k: one.values_.tolist() for k, one in zip(scores.columns, martingales, strict=True)},
    }
