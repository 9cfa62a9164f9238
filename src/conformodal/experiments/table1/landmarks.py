"""What landmarks are worth: they alone, ours without them, and the opponent with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from conformodal.odometry import OdometryRun, PoseModel, as_trajectory
from conformodal.poses import Trajectory, concatenate, normalise_quat
from conformodal.reasoning import Candidates, Observations, smooth, viterbi

from ..classical import ClassicalRegressor


def landmark_rows(
    model: PoseModel,
    features: npt.NDArray[np.float32],
    run: OdometryRun,
    recording: npt.NDArray[np.int64],
    classical: ClassicalRegressor,
) -> dict[str, Trajectory]:
    """Trajectories over the frames of a run, which may hold several recordings.

    ``landmarks``: each frame's most trusted fix, and our softmax mean where it has none. ``no_landmarks``: ours without
    fixes. ``classical_landmarks``: the classical regressor's answers and the fixes, through our search and smoother.
    """
    single = [
        model.with_fixes(own, its.search) for own, its in zip(_answers(classical, features), run.fixes, strict=True)
    ]
    choices = {"no_landmarks": model.candidates(model.search(features)), "classical_landmarks": single}
    found = {"landmarks": _fixes_alone(run)}
    pieces = [np.flatnonzero(recording == number) for number in np.unique(recording)]
    for name, candidates in choices.items():
        seen = (replace(run.observations(at), candidates=[candidates[t] for t in at]) for at in pieces)
        found[name] = concatenate([_reasoned(part, model) for part in seen])
    return found


def _reasoned(seen: Observations, model: PoseModel) -> Trajectory:
    return as_trajectory(smooth(viterbi(seen, model.prior), seen, model.prior))


def _answers(classical: ClassicalRegressor, features: npt.NDArray[np.float32]) -> Sequence[Candidates]:
    """The classical answers as candidates, one a frame."""
    values = classical.predict(features)
    spread, angle = classical.spread_m[None], np.array([classical.spread_rad])
    return [Candidates(v[None, :3], spread, normalise_quat(v[None, 3:]), angle, np.zeros(1)) for v in values]


def _fixes_alone(run: OdometryRun) -> Trajectory:
    mean = run.trajectories["softmax_mean"]
    positions, quats = mean.positions_xyz.copy(), mean.orientations_quat_wxyz.copy()
    for t, fixes in enumerate(run.fixes):
        if fixes.search:
            best = max(fixes.search, key=lambda fix: (fix.trust, fix.n_inliers))
            positions[t], quats[t] = best.position_xyz, best.orientation_quat_wxyz
    return Trajectory(run.timestamps_s, positions, quats)
