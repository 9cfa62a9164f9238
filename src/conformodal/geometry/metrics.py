"""Errors of an estimated trajectory against the truth: per frame, per motion, and drift."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray

from .rotations import PoseError, angle_between_quats
from .trajectory import Trajectory

# Matches what common tools use to pair estimated and true timestamps.
MAX_TIME_DIFFERENCE_S = 0.01
# Between two poses that one is interpolated from: images of 10 Hz poses are bridged, a lost pose among them is not.
MAX_GAP_S = 0.15
_SAME_S = 1e-3  # a pose as near in time is taken as it is
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_SINCE_1970_S = 1e8
_UNITS = {"nanoseconds": 1e9, "microseconds": 1e6, "milliseconds": 1e3}
_NO_SECONDS = 1e11  # the year five thousand
_KITTI_EVERY = 10  # frames between the starts of stretches


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
    """``rmse_m`` = sqrt(mean squared position error), ``rmse_deg`` alike, and the medians."""
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
    """Share of poses within thresholds of both position and orientation, by ``"0.05 m, 5 deg"``."""
    metres, degrees = _pose_errors(estimate, truth)
    return {f"{m:g} m, {d:g} deg": float(np.mean((metres <= m) & (degrees <= d))) for m, d in _RECALL_THRESHOLDS}


class TimePairs(NamedTuple):
    """Indices (m,) of poses that belong together."""

    estimate: IntArray
    truth: IntArray


def associate(estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_TIME_DIFFERENCE_S) -> TimePairs:
    """Pair every estimated pose with the nearest true one in time, within `max_difference_s` seconds."""
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
            f"truth {times.min():.3f} to {times.max():.3f} s{clock_hint(estimate.timestamps_s, times)}"
        )
    return TimePairs(np.flatnonzero(matched), order[nearest[matched]])


def in_seconds(times: FloatArray) -> tuple[FloatArray, str]:
    """Times in seconds; and their unit, if they are too large for seconds, else nothing.

    Those since 1970 show it by their size, those of another clock by their steps, of 0.1 to 1000 per second.
    """
    finite = np.unique(times[np.isfinite(times)])
    size = float(np.median(np.abs(finite))) if finite.size else 0.0
    if size < _NO_SECONDS:
        return times, ""
    step = float(np.median(np.diff(finite))) if finite.size > 1 else 0.0
    for unit, per_second in _UNITS.items():
        if 0.5 < size / (1e9 * per_second) < 5 and step < 10 * per_second:  # 1985 to 2128
            return times / per_second, unit
    unit = next((unit for unit, per_second in _UNITS.items() if step >= per_second / 1000), "milliseconds")
    return times / _UNITS[unit], unit


def clock_hint(times_s: FloatArray, others_s: FloatArray) -> str:
    """Why two sets of times do not meet, where their size shows it; else nothing."""
    sizes = [float(np.median(t)) for t in (times_s, others_s)]
    spans = sorted((float(np.ptp(times_s)), float(np.ptp(others_s))))
    for unit, per_second in _UNITS.items():
        if 0 < spans[0] * per_second / 3 < spans[1] < 3 * spans[0] * per_second:
            return f"; one covers {spans[1]:.4g}, the other {spans[0]:.4g}: looks like {unit}, expected seconds"
    if times_s.max() < others_s.min() or others_s.max() < times_s.min():
        counts = "; one counts from 1970" if max(sizes) > _SINCE_1970_S > min(sizes) else ""
        return f"; the clocks are {abs(sizes[0] - sizes[1]):.6g} s apart{counts}: shift the poses by --time-offset"
    return ""


class InterpolatedPoses(NamedTuple):
    """Poses at other times than those of a path."""

    rows: FloatArray  # (n, 7) ``x y z qw qx qy qz``, NaN where there is no pose
    gaps_s: FloatArray  # (n,) between the poses around each time: 0 where one is taken as it is, infinite outside


def poses_at(path: Trajectory, times_s: FloatArray, max_gap_s: float = MAX_GAP_S) -> InterpolatedPoses:
    """Poses of a path at other times, interpolated: positions linearly, orientations on the great arc.

    The poses may be in any order of time. Those at most `max_gap_s` apart are bridged; before the first pose and after
    the last there is none. A pose within a millisecond is taken as it is.
    """
    poses, gaps = np.full((len(times_s), 7), np.nan), np.full(len(times_s), np.inf)
    if not len(path):
        return InterpolatedPoses(poses, gaps)
    order = np.argsort(path.timestamps_s, kind="stable")
    times, rows = path.timestamps_s[order], np.column_stack((path.positions_xyz, path.orientations_quat_wxyz))[order]
    near = nearest_in_time(times, times_s)
    same = np.abs(times[near] - times_s) <= _SAME_S
    poses[same], gaps[same] = rows[near[same]], 0.0
    after = np.searchsorted(times, times_s)
    inside = np.flatnonzero(~same & (after > 0) & (after < len(times)))
    gaps[inside] = times[after[inside]] - times[after[inside] - 1]
    inside = inside[gaps[inside] <= max_gap_s]
    left, right = rows[after[inside] - 1], rows[after[inside]]
    share = ((times_s[inside] - times[after[inside] - 1]) / gaps[inside])[:, None]
    poses[inside, :3] = left[:, :3] + share * (right[:, :3] - left[:, :3])
    first, last = (Rotation.from_quat(side[:, 3:], scalar_first=True) for side in (left, right))
    turned = first * Rotation.from_rotvec(share * (first.inv() * last).as_rotvec())
    poses[inside, 3:] = turned.as_quat(scalar_first=True)
    return InterpolatedPoses(poses, gaps)


def nearest_in_time(times_s: FloatArray, asked_s: FloatArray) -> IntArray:
    """Index of the time nearest to each of `asked_s`, the earlier of two; `times_s` must increase."""
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


class MotionErrors(NamedTuple):
    """Errors (n,) of motions between two frames."""

    metres: FloatArray
    degrees: FloatArray


def relative_errors(estimate: Trajectory, truth: Trajectory, delta: int = 1) -> MotionErrors:
    """Errors of the n - `delta` motions over `delta` frames (Sturm et al. 2012, eq. 2)."""
    check_same_length(estimate, truth)
    if delta < 1 or len(truth) <= delta:
        raise PoseError(
            f"relative errors need delta of at least 1 and more than delta poses, got {delta}, {len(truth)}"
        )
    starts = np.arange(len(truth) - delta)
    return _motion_errors(estimate, truth, starts, starts + delta)


class Drift(NamedTuple):
    """Mean drift of stretches of a path."""

    percent: float  # of their length
    degrees_per_metre: float


def kitti_drift(estimate: Trajectory, truth: Trajectory) -> Drift:
    """KITTI's drift over 100 to 800 m (Geiger et al. 2012).

    Segments start at every tenth frame and end where the true path has the nominal length.
    """
    check_same_length(estimate, truth)
    steps = np.linalg.norm(np.diff(truth.positions_xyz, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    percents, rates = [], []
    for length in KITTI_LENGTHS_M:
        starts = np.arange(0, len(truth), _KITTI_EVERY)
        ends = np.searchsorted(along, along[starts] + length, side="right")  # the first frame beyond
        inside = ends < len(truth)
        metres, degrees = _motion_errors(estimate, truth, starts[inside], ends[inside])
        percents.append(100 * metres / length)
        rates.append(degrees / length)
    percent, rate = np.concatenate(percents), np.concatenate(rates)
    if not percent.size:
        raise PoseError(f"the true path is {along[-1]:.1f} m long; drift needs stretches of at least 100 m")
    return Drift(float(percent.mean()), float(rate.mean()))


def _motion_errors(estimate: Trajectory, truth: Trajectory, starts: IntArray, ends: IntArray) -> MotionErrors:
    """Sizes of ``(truth_i^-1 truth_j)^-1 (estimate_i^-1 estimate_j)``."""
    motions = []
    for path in (truth, estimate):
        rotation = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True)
        back = rotation[starts].inv()
        motions.append((back * rotation[ends], back.apply(path.positions_xyz[ends] - path.positions_xyz[starts])))
    (R_true, t_true), (R, t) = motions
    # turning the difference back into the frame at the end does not change its length
    return MotionErrors(np.linalg.norm(t - t_true, axis=1), np.degrees((R_true.inv() * R).magnitude()))
