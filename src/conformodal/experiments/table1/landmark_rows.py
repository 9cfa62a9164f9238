"""Trajectories that show the worth of landmarks: landmarks alone, ours without, and the regressor with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from conformodal.localization import FrameEvidence
from conformodal.odometry import OdometryRun, PoseModel, rows_by_recording, whole_paths
from conformodal.poses import Trajectory, concatenate, normalise_quat
from conformodal.reasoning import Candidates, softmax_mean

from ..classical import ClassicalRegressor


def landmark_rows(
    model: PoseModel,
    features: npt.NDArray[np.float32],
    run: OdometryRun,
    recording: npt.NDArray[np.int64],
    classical: ClassicalRegressor,
) -> dict[str, Trajectory]:
    """Trajectories over the frames of a run, which may hold several recordings.

    ``landmarks``: each frame's most probable estimate by landmarks, and the softmax mean where it has none.
    ``no_landmarks``: ours without local features. ``classical_landmarks``: the classical regressor's answers and the
    landmarks' estimates, through our search and smoother.
    """
    estimates = run.localization.beliefs.estimates
    answers = _answers(classical, features)
    single = [model.localizer.update(own, [its]).candidates for own, its in zip(answers, estimates, strict=True)]
    choices = {"no_landmarks": model.localize(FrameEvidence(features)).candidates, "classical_landmarks": single}
    found = {"landmarks": _landmarks_alone(run, model)}
    pieces = rows_by_recording(recording)
    for name, candidates in choices.items():
        seen = (replace(run.observations(at), candidates=[candidates[t] for t in at]) for at in pieces)
        found[name] = concatenate([whole_paths(part, model.prior)["smoothed"] for part in seen])
    return found


def _answers(classical: ClassicalRegressor, features: npt.NDArray[np.float32]) -> Sequence[Candidates]:
    """Predictions of the classical regressor as candidates, one a frame."""
    values = classical.predict(features)
    spread, angle = classical.spread_m[None], np.array([classical.spread_rad])
    return [Candidates(v[None, :3], spread, normalise_quat(v[None, 3:]), angle, np.zeros(1)) for v in values]


def _landmarks_alone(run: OdometryRun, model: PoseModel) -> Trajectory:
    beliefs = run.localization.beliefs
    mean = softmax_mean(beliefs.proba, model.bins)
    positions, quats = mean[:, :3].copy(), mean[:, 3:].copy()
    for t, estimates in enumerate(beliefs.estimates):
        if estimates:
            best = max(estimates, key=lambda one: (one.inlier_probability, one.n_inliers))
            positions[t], quats[t] = best.position_xyz, best.orientation_quat_wxyz
    return Trajectory(run.timestamps_s, positions, quats)
