"""Errors, regions and cost of this project's system and of every baseline, at one noise."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from conformodal.localization import FrameEvidence, pose_targets
from conformodal.odometry import error_table, rows_by_recording, whole_paths
from conformodal.poses import angle_between_quats

from ..compared_paths import comparison_paths
from ..plain import trajectory_of
from .costs import ms_a_frame, timed
from .landmark_rows import landmark_rows
from .noisy_runs import NoisyRun
from .region_numbers import in_deviations, position_error, position_size, region_numbers
from .trained import Trained


def our_results(trained: Trained, found: NoisyRun) -> dict[str, Any]:
    """Results of one noise; JSON. Trajectories of the other methods are added to the run."""
    model, run, features, truth = trained.model, found.run, found.features, found.truth
    answer_ms = {} if found.sigma else _answer_times(trained, found)  # noise costs nothing
    run.trajectories |= {
        **comparison_paths(run, model, found.recording),
        "plain": trained.plain.trajectory(features, run.timestamps_s),
        **trained.classical.trajectories(features, run, found.recording, model.prior),
        **landmark_rows(model, features, run, found.recording, trained.classical),
        **{name: trajectory_of(b.answer(features), run.timestamps_s) for name, b in trained.baselines.items()},
    }
    return {
        "errors": error_table(run.trajectories, truth),
        "region": region_numbers(run, model, features, truth),
        "frames": _frame_numbers(trained, found),
        **_interval_numbers(trained, found),
        "answer_ms": answer_ms,
        "n_unreliable": int(np.sum(~run.reliable)),
    }


def _interval_numbers(trained: Trained, found: NoisyRun) -> dict[str, Any]:
    """Coverage and length of the intervals of each baseline that has some."""
    targets, numbers = pose_targets(found.truth, trained.model.sign_reference), {}
    for name, baseline in trained.baselines.items():
        if baseline.interval is not None:
            lower, upper = baseline.interval(found.features)
            numbers[name] = {
                "coverage": float(((targets >= lower) & (targets <= upper)).mean()),
                "length": in_deviations(upper - lower, targets),
            }
    return numbers


def _answer_times(trained: Trained, found: NoisyRun) -> dict[str, float]:
    """Milliseconds a frame of every method's answers, once the features are there."""
    n = len(found.features)
    _, seconds = timed(partial(_answer, trained, found))  # once: all of it has just been done before
    times = {"smoothed": 1e3 * seconds / n}
    return times | {name: ms_a_frame(partial(f, found.features), n) for name, f in trained.predictors.items()}


def _answer(trained: Trained, found: NoisyRun) -> None:
    """All that leads from features, local features and motions to regions and the smoothed answer, and nothing else."""
    model, run = trained.model, found.run
    local = [found.motions.local_features[i] for i in run.frames.tolist()]
    candidates = model.localize(FrameEvidence(found.features, local)).candidates
    for at in rows_by_recording(found.recording):
        whole_paths(replace(run.observations(at), candidates=[candidates[t] for t in at]), model.prior)


def _frame_numbers(trained: Trained, found: NoisyRun) -> dict[str, list[float | None]]:
    """Size of the position's region, error, and turning rate since the tested frame before (rad/s), frame by frame.

    None stands for a rate that is not there, and for a number that is not finite.
    """
    truth, quats = found.truth, found.truth.orientations_quat_wxyz
    turn = np.full(len(truth), np.nan)
    turn[1:] = angle_between_quats(quats[1:], quats[:-1]) / np.diff(truth.timestamps_s)
    turn[1:][np.diff(found.recording) != 0] = np.nan
    size, error = position_size(found.run.regions, trained.model), position_error(found.run, truth)
    numbers = {"size_m": size, "error_m": error, "turn_rad_s": turn}
    return {k: [float(f"{v:.4g}") if np.isfinite(v) else None for v in values] for k, values in numbers.items()}
