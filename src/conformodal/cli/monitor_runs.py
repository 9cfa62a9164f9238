"""What ``conformodal monitor`` tests of runs of a pose model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.conformal import unit_scores
from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import WORST_SCORE, read_run
from conformodal.pipeline.store import load_model, model_digest

from .console import report_line
from .monitored import MonitoredScores, named_few

_OTHER_RECORDING = (
    "stretches of the training recordings calibrate this model: an alarm may mean no more than that these are other "
    "recordings, of which nothing is guaranteed"
)
_NEIGHBOURS = (
    "random frames calibrate this model: an alarm may mean no more than that these are other frames than those drawn "
    "at random from the training recordings"
)
_ONLY_NOVELTY = (
    "without true poses this tests whether images show known places, not coverage: for that, run on recordings with "
    "poses"
)


def scores_of_runs(folder: Path, results: Sequence[Path], seed: int) -> MonitoredScores:
    """Scores of the recordings that runs of a model answered: of true poses if a run has some, else of novelty."""
    model, digest = load_model(folder), model_digest(folder)
    rule, given, runs = model.calibration, set[Path](), dict[str, list[dict[str, Any]]]()
    for path in results:
        run = read_run(path)
        if run.metrics.get("model") != digest:
            raise OdometryError(f"{path}: is not a run of the model in {folder}; run that model again")
        if path in given:
            raise OdometryError(f"{path}: is given twice")
        given.add(path)
        several = len({one.get("recording", 0) for one in run.records}) > 1
        for one in run.records:
            name = f"{path}, recording {one['recording'] + 1}" if several else str(path)
            runs.setdefault(name, []).append(one)
    with_truth = {path for path, records in runs.items() if any(one.get("score") is not None for one in records)}
    key = "score" if with_truth else "known_p"
    if key == "known_p" and model.novelty is None:
        raise OdometryError(f"{folder}: no run has true poses, and the model has no test of novelty")
    values = {path: _values(records, key) for path, records in runs.items()}
    if without := [path for path, of_run in values.items() if not len(of_run)]:
        report_line(f"left out: {counted(len(without), 'recording')} without true poses: {named_few(without)}")
    n_lacking = sum(len(runs[path]) - len(of_run) for path, of_run in values.items() if len(of_run))
    if n_lacking:
        report_line(f"left out: {counted(n_lacking, 'frame')} without {'a true pose' if with_truth else 'a p-value'}")
    before = rule.columns(rule.scores_).max(axis=1) if with_truth else -model.rules.known_p
    before = np.minimum(before, WORST_SCORE)
    limits = [] if with_truth else [_ONLY_NOVELTY]
    noun, units = _units_of(model, {path: of_run for path, of_run in values.items() if len(of_run)}, seed)
    if rule.units_ is not None:
        before = unit_scores(before, rule.units_, model.alpha)[1]
        units = {name: unit_scores(part, np.zeros(len(part)), model.alpha)[1] for name, part in units.items()}
    if noun != "recording":
        limits.append(_NEIGHBOURS if rule.units_ is None else _OTHER_RECORDING)
    new = np.array([float(part[0]) for part in units.values()])
    plural = "stretches" if noun == "stretch" else f"{noun}s"
    quantity = "scores of true poses" if with_truth else "novelty"
    return MonitoredScores(noun, plural, quantity, ["pose"], before[:, None], new[:, None], [*units], limits=limits)


def _values(records: Sequence[dict[str, Any]], key: str) -> FloatArray:
    """Scores of the frames that have one."""
    values = np.array([one[key] for one in records if one.get(key) is not None], dtype=np.float64)
    return -values if key == "known_p" else values


def _units_of(model: PoseModel, values: dict[str, FloatArray], seed: int) -> tuple[str, dict[str, FloatArray]]:
    """What a unit is, and the scores of each unit of the recordings, in order.

    Units are those that calibrate: recordings; stretches as long as these; or single frames, in random order, since
    neighbours are alike.
    """
    rule = model.calibration
    if rule.units_ is None:
        random = np.random.default_rng(seed)
        order = {path: random.permutation(len(part)) for path, part in values.items()}
        return "frame", {f"{p}, frame {i}": values[p][i : i + 1] for p in values for i in order[p].tolist()}
    if model.configuration.get("whole_recordings"):
        return "recording", values
    size = float(np.median(np.unique(rule.units_, return_counts=True)[1]))
    parts = {path: np.array_split(part, max(1, round(len(part) / size))) for path, part in values.items()}
    return "stretch", {f"{p}, stretch {k}": part for p, of_run in parts.items() for k, part in enumerate(of_run, 1)}
