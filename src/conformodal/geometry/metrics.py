"""An estimated trajectory against the truth: pairing in time, alignment (Umeyama 1991), errors."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.ranges import as_member

from .poses import PoseError, Trajectory, angle_between_quats

# Between two poses that one is interpolated from: images of 10 Hz poses are bridged, a lost pose among them is not.
MAX_GAP_S = 0.15
_SAME_S = 1e-3  # a pose as near in time is taken as it is
# Of the spread along a path, and of the residuals: less across it leaves its roll open.
_STRAIGHT, _RESIDUALS = 0.02, 3.0


def position_errors_m(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Distance in metres between estimated and true camera centres, (n,)."""
    _check_same_length(estimate, truth)
    return np.asarray(np.linalg.norm(estimate.positions_xyz - truth.positions_xyz, axis=1))


def orientation_errors_deg(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Angle in degrees between estimated and true orientations, (n,)."""
    _check_same_length(estimate, truth)
    angles = angle_between_quats(estimate.orientations_quat_wxyz, truth.orientations_quat_wxyz)
    return np.asarray(np.degrees(angles))


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """``rmse_m`` = sqrt(mean squared position error), ``rmse_deg`` alike, and the medians."""
    if len(truth) == 0:
        raise PoseError("a trajectory without poses has no error")
    metres, degrees = position_errors_m(estimate, truth), orientation_errors_deg(estimate, truth)
    return {
        "rmse_m": float(np.sqrt(np.mean(metres**2))),
        "rmse_deg": float(np.sqrt(np.mean(degrees**2))),
        "median_m": float(np.median(metres)),
        "median_deg": float(np.median(degrees)),
    }


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


def _check_same_length(estimate: Trajectory, truth: Trajectory) -> None:
    """Refuse trajectories that are not paired pose by pose."""
    if len(estimate) != len(truth):
        raise PoseError(f"estimate has {len(estimate)} poses, truth {len(truth)}; pair them first (poses_at)")


class Alignment(StrEnum):
    """Transformations that may be applied to an estimate before it is compared."""

    NONE = "none"
    SE3 = "se3"  # rotation and translation
    SIM3 = "sim3"  # and scale, as for one camera that knows none
    YAW = "yaw"  # rotation about the world's z axis, for two worlds whose z is up, and translation


class Similarity(NamedTuple):
    """The transformation ``target = scale R source + t``."""

    R: FloatArray  # (3, 3)
    t: FloatArray  # (3,)
    scale: float


def umeyama(source: FloatArray, target: FloatArray, *, with_scale: bool) -> Similarity:
    """The similarity of least squared distance between points (n, 3)."""
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or len(source) < 3:
        raise PoseError(f"alignment needs three or more pairs of points (n, 3), got {source.shape}, {target.shape}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - mean_source
    covariance = (target - mean_target).T @ centred / len(source)
    u, d, vt = np.linalg.svd(covariance)
    if not d[1] > np.finfo(np.float64).eps * max(d[0], np.finfo(np.float64).tiny) * 8:
        raise PoseError("alignment is undetermined: the positions lie on a line or in one place")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # a rotation, no mirror
    R = (u * signs) @ vt
    s = float(d @ signs / np.mean(np.sum(centred**2, axis=1))) if with_scale else 1.0
    return Similarity(R, mean_target - s * R @ mean_source, s)


def align(estimate: Trajectory, truth: Trajectory, how: Alignment | str) -> Trajectory:
    """The estimate, aligned with the truth, with which it must be paired."""
    kind = as_member(how, Alignment, "alignment", PoseError)
    _check_same_length(estimate, truth)
    if kind is Alignment.NONE:
        return estimate
    p, q = estimate.positions_xyz, estimate.orientations_quat_wxyz
    if kind is Alignment.YAW:
        means = p.mean(axis=0), truth.positions_xyz.mean(axis=0)
        (x, y), (u, v) = (p - means[0]).T[:2], (truth.positions_xyz - means[1]).T[:2]
        R = Rotation.from_euler("z", np.arctan2(x @ v - y @ u, x @ u + y @ v)).as_matrix()
        t, s = means[1] - R @ means[0], 1.0
    else:
        R, t, s = umeyama(p, truth.positions_xyz, with_scale=kind is Alignment.SIM3)
    turned = Rotation.from_matrix(R) * Rotation.from_quat(q, scalar_first=True)
    return Trajectory(estimate.timestamps_s, s * p @ R.T + t, turned.as_quat(scalar_first=True))


def straightness(truth: Trajectory, residual_m: float = 0.0, unit: str = "m") -> str:
    """Why aligning to a path leaves the rotation about it open, or nothing.

    A path that hardly leaves a line fixes two angles; the third is what makes the errors of the positions smallest.
    `residual_m` is what is left of these errors after alignment, RMS; `unit` that of lengths.
    """
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(truth.positions_xyz.T)), 0))[::-1]
    if spread[1] > max(_STRAIGHT * spread[0], _RESIDUALS * residual_m):
        return ""
    return (
        f"the path is nearly straight ({spread[0]:.2g} {unit} along, {spread[1]:.2g} {unit} across, RMS): the rotation "
        "about it is hardly determined, and fitted; where z is up in both worlds, align by yaw"
    )


class MotionErrors(NamedTuple):
    """Errors (n,) of motions between two frames."""

    metres: FloatArray
    degrees: FloatArray


def relative_errors(estimate: Trajectory, truth: Trajectory) -> MotionErrors:
    """Errors of the n - 1 motions from frame to frame (Sturm et al. 2012, eq. 2)."""
    _check_same_length(estimate, truth)
    motions = []
    for path in (truth, estimate):
        rotation = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True)
        back = rotation[:-1].inv()
        motions.append((back * rotation[1:], back.apply(np.diff(path.positions_xyz, axis=0))))
    (R_true, t_true), (R, t) = motions
    # turning the difference back into the frame at the end does not change its length
    return MotionErrors(np.linalg.norm(t - t_true, axis=1), np.degrees((R_true.inv() * R).magnitude()))
