"""What ``conformodal monitor`` tests of the rows of tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from conformodal.conformal import ConformalRegressor, DataWarning, unit_scores
from conformodal.conformal.tables import as_inputs
from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .console import report_line, warning_lines
from .monitored import MonitoredScores, named_few
from .table import check_targets, total_rows
from .table_csv import CsvFormat, TableError, read_table
from .table_predict import as_learnt


def scores_of_tables(model: Path, files: Sequence[Path], unit: str | None, named: CsvFormat) -> MonitoredScores:
    """Scores of the rows of CSV files under a saved regressor, in the order of files and rows.

    Files are written as the one learnt from, except for what is `named`.
    """
    reg = ConformalRegressor.load(model)
    calibrator = reg.calibrator_
    targets = reg.bins_.names
    if not targets:
        raise TableError(f"{model}: was fitted on arrays without names, so the columns of a file are not known")
    of_units = getattr(calibrator, "units_", None) is not None
    if of_units != (unit is not None):
        expected = "name the column of the units that calibrate" if of_units else "be left out: rows calibrate"
        raise TableError(f"{model}: --unit must {expected}")
    parts = [_scored_rows(reg, file, unit, named) for file in files]
    names = [name for part in parts for name in part.names]
    before, new = calibrator.columns(calibrator.scores_), np.concatenate([part.scores for part in parts])
    noun, labels, new_labels = "row", None, None
    if unit is not None:
        noun, members = f"unit of {unit}", [label for part in parts for label in part.labels]
        before = np.column_stack([unit_scores(column, calibrator.units_, reg.alpha)[1] for column in before.T])
        of_unit = [unit_scores(column, members, reg.alpha) for column in new.T]
        order = list(dict.fromkeys(members))  # as they came
        at = np.searchsorted(of_unit[0][0], order)
        new, names = np.column_stack([scores for _, scores in of_unit])[at], [f"{unit} {label}" for label in order]
    elif reg.group_column_ is not None:
        labels, new_labels = calibrator.groups_, [label for part in parts for label in part.labels]
    plural = f"units of {unit}" if unit is not None else "rows"
    columns = list(targets) if before.shape[1] > 1 else [", ".join(targets)]
    return MonitoredScores(
        noun, plural, "scores of true values", columns, before, new, names, labels, new_labels, False
    )


@dataclass(frozen=True, eq=False)
class _ScoredRows:
    """The rows of a file."""

    scores: FloatArray  # (n, c)
    names: list[str]
    labels: list[Any]  # of units or groups


def _scored_rows(reg: ConformalRegressor, file: Path, unit: str | None, named: CsvFormat) -> _ScoredRows:
    targets, label = list(reg.bins_.names or ()), unit if unit is not None else reg.group_column_
    needed = [*targets, *([] if label is None else [label])]
    frame, notes = read_table(file, as_learnt(reg, named, needed))
    for note in notes:
        report_line(note)
    for name in needed:
        if name not in frame:
            raise TableError(f"{file}: has no column {name!r}, which is needed to score rows")
    check_targets(frame, targets, str(file))
    totals = total_rows(frame)
    if totals.any():
        lines = named_few([str(line) for line in frame.index[totals]])
        report_line(f"{file}: left out: {counted(int(totals.sum()), 'row')} with totals of the others (lines {lines})")
        frame = frame[~totals]
    whole = frame[needed].notna().all(axis=1)
    if not whole.any():
        raise TableError(f"{file}: no row has all of {', '.join(needed)}")
    if n_gaps := int((~whole).sum()):
        lines = named_few([str(line) for line in frame.index[~whole]])
        report_line(f"{file}: left out: {counted(n_gaps, 'row')} without {' or '.join(needed)} (lines {lines})")
    frame = frame[whole]
    try:
        inputs = as_inputs(reg, frame)[reg.columns_]
    except ConformodalError as exc:
        raise TableError(f"{file}: {exc}") from None
    with warning_lines(DataWarning, lambda text: report_line(f"note: {file}: {text}", bold=True)):
        reg.compare_rows(inputs)
    calibrator = reg.calibrator_
    scores = calibrator.columns(calibrator.score_samples(reg.proba_of(inputs), frame[targets].to_numpy(np.float64)))
    labels = [] if label is None else _as_labels(frame[label], unit is not None)
    return _ScoredRows(scores, [f"{file}, line {line}" for line in frame.index], labels)


def _as_labels(column: pd.Series, as_text: bool) -> list[Any]:
    """Labels as `table fit` makes them: of units text; of groups whole numbers where all are."""
    if as_text:
        return list(column.astype(str))
    if column.dtype.kind == "f" and (column % 1 == 0).all():
        return list(column.astype(int))
    return list(column)
