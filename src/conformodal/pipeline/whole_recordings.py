"""Whole recordings in the place of stretches in the calibration of a model that recordings have joined."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace

import numpy as np

from conformodal.core.arrays import IntArray, RealArray
from conformodal.core.words import counted

from .model import PoseModel


def n_recordings_needed(model: PoseModel) -> int:
    """Recordings that a finite threshold at the model's alpha needs."""
    return math.ceil(1 / model.calibration.alpha_per_target) - 1


def describe_units(model: PoseModel) -> str:
    """What calibrates an extended model, in a sentence."""
    n, needed = len(model.journal_with_poses), n_recordings_needed(model)
    if model.configuration.get("whole_recordings"):
        return f"Whole recordings calibrate: {model.calibration.n_units}, of which {n} joined after training."
    return (
        f"Stretches calibrate: {model.calibration.n_units}, those of {counted(n, 'recording')} that joined after "
        f"training with poses among them. Whole recordings will, once {needed} have joined and no regions become "
        "unbounded by it."
    )


def _loses_bounded(before: RealArray, now: RealArray) -> bool:
    """Whether finite thresholds (n, 7) have become infinite."""
    return bool((np.isfinite(before).all(axis=1) & ~np.isfinite(now).all(axis=1)).any())


def calibrate_by_recordings(model: PoseModel) -> PoseModel:
    """The model calibrated on whole recordings, once enough have joined; else as it is.

    Each was answered by a map that had not seen it. Stretches of the training recordings were answered by maps that had
    seen their neighbours, and no longer calibrate, but for disturbed images, of which there are copies of those alone.
    Neither an evidence type nor a path loses its bounded regions in any room. The test of novelty stays as it is, with
    stretches as units: p-values of calibration frames and of new images keep one scale, and few recordings would make
    the least p-value larger than the significance level.
    """
    journal = model.journal_with_poses
    if model.configuration.get("whole_recordings") or len(journal) < n_recordings_needed(model):
        return model
    first = journal[0].first_unit
    ends = np.array([entry.first_unit + entry.n_units for entry in journal])

    def recordings_of(units: IntArray) -> IntArray:
        return first + np.searchsorted(ends, units, side="right")

    rules, overall = model.rules, model.rules.overall
    assert overall.units_ is not None
    later = overall.units_ >= first
    by_recording = replace(
        rules,
        overall=copy(overall).calibrate_scores(overall.scores_[later], recordings_of(overall.units_[later])),
        recognised=None if rules.recognised is None else rules.recognised[later],
        known_p=rules.known_p[later],
        rooms=None if rules.rooms is None else rules.rooms[later],
    )
    rooms = np.zeros(1, np.int64) if rules.rooms is None else np.unique(rules.rooms)
    kinds = np.repeat(np.array([*rules.by_type], np.int64), len(rooms)), np.tile(rooms, len(rules.by_type))
    if _loses_bounded(rules.thresholds(*kinds), by_recording.thresholds(*kinds)):
        return model
    sizes = np.array([entry.n_frames for entry in journal])
    path_rules = {}
    for path, rule in model.path_rules.items():
        units = rule.calibration.units_
        assert units is not None
        rows = units >= first
        number = recordings_of(units[rows])
        calibration = copy(rule.calibration).calibrate_scores(
            rule.calibration.scores_[rows], number, sizes[number - first]
        )
        path_rules[path] = replace(
            rule,
            calibration=calibration,
            squared=rule.squared[rows],
            known_p=rule.known_p[rows],
            rooms=rule.rooms[rows],
        )
        if _loses_bounded(*(each.thresholds(rule.novel, rule.rooms) for each in (rule, path_rules[path]))):
            return model
    return replace(
        model,
        rules=by_recording,
        path_rules=path_rules,
        comparison=None,
        configuration={**model.configuration, "whole_recordings": True},
    )
