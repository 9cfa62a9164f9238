"""Errors of an estimated trajectory against the truth, frame by frame and without alignment."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray

from .errors import PoseError
from .rotations import angle_between_quats
from .trajectory import Trajectory

# Matches what common tools use to pair estimated and true timestamps.
MAX_TIME_DIFFERENCE_S = 0.01


def position_errors_m(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Distance in metres between estimated and true camera centres, (n,)."""
    check_same_length(estimate, truth)
    return np.asarray(np.linalg.norm(estimate.positions_xyz - truth.positions_xyz, axis=1))


def orientation_errors_deg(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Angle in degrees between estimated and true orientations, (n,)."""
    check_same_length(estimate, truth)
    angles = angle_between_quats(estimate.orientations_quat_wxyz, truth.orientations_quat_wxyz)
    return np.asarray(np.degrees(angles))


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """``rmse_m`` = sqrt(mean squared position error), ``rmse_deg`` alike, and the medians.

    Raises
    ------
    PoseError
        If the two differ in length or hold no pose.
    """
    metres, degrees = _pose_errors(estimate, truth)
    return {
        "rmse_m": float(np.sqrt(np.mean(metres**2))),
        "rmse_deg": float(np.sqrt(np.mean(degrees**2))),
        "median_m": float(np.median(metres)),
        "median_deg": float(np.median(degrees)),
    }


# Metres and degrees, as re-localisation papers give them.
_RECALL_THRESHOLDS = ((0.05, 5.0), (0.1, 1.0), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


def recall(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Share of poses within metres and degrees of the truth, both at once; by ``"0.05 m, 5 deg"``.

    Raises
    ------
    PoseError
        If the two differ in length or hold no pose.
    """
    metres, degrees = _pose_errors(estimate, truth)
    return {f"{m:g} m, {d:g} deg": float(np.mean((metres <= m) & (degrees <= d))) for m, d in _RECALL_THRESHOLDS}


def associate(
    estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_TIME_DIFFERENCE_S
) -> tuple[IntArray, IntArray]:
    """Pair every estimated pose with the nearest true one in time: indices into both, equally long.

    Raises
    ------
    PoseError
        If no pair is within `max_difference_s` seconds.
    """
    if len(estimate) == 0 or len(truth) == 0:
        raise PoseError(f"{len(estimate)} estimated and {len(truth)} true poses cannot be paired")
    order = np.argsort(truth.timestamps_s, kind="stable")
    times = truth.timestamps_s[order]
    nearest = nearest_in_time(times, estimate.timestamps_s)
    matched = np.abs(times[nearest] - estimate.timestamps_s) <= max_difference_s
    if not matched.any():
        raise PoseError(
            f"no estimated pose has a true one within {max_difference_s} s: estimates span "
            f"{estimate.timestamps_s.min():.3f} to {estimate.timestamps_s.max():.3f} s, "
            f"truth {times.min():.3f} to {times.max():.3f} s"
        )
    return np.flatnonzero(matched), order[nearest[matched]]


def nearest_in_time(times_s: FloatArray, asked_s: FloatArray) -> IntArray:
    """Index of the time nearest to each asked one, the earlier of two; `times_s` increase and hold at least one."""
    right = np.minimum(np.searchsorted(times_s, asked_s), len(times_s) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(times_s[left] - asked_s) <= np.abs(times_s[right] - asked_s)
    return np.where(closer_left, left, right)


def _pose_errors(estimate: Trajectory, truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    if len(truth) == 0:
        raise PoseError("a trajectory without poses has no error")
    return position_errors_m(estimate, truth), orientation_errors_deg(estimate, truth)


def check_same_length(estimate: Trajectory, truth: Trajectory) -> None:
    """Refuse trajectories that are not paired pose by pose."""
    if len(estimate) != len(truth):
        raise PoseError(f"estimate has {len(estimate)} poses, truth {len(truth)}; pair them first (associate)")
