"""Aligning an estimated trajectory with the truth (Umeyama 1991)."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.core.ranges import as_member

from .metrics import check_same_length
from .rotations import PoseError
from .trajectory import Trajectory

# Of the spread along a path, and of the residuals: less across it leaves its roll open.
_STRAIGHT, _RESIDUALS = 0.02, 3.0


class Alignment(StrEnum):
    """Transformations that may be applied to an estimate before it is compared."""

    NONE = "none"
    SE3 = "se3"  # rotation and translation
    SIM3 = "sim3"  # and scale, as for one camera that knows none
    YAW = "yaw"  # rotation about the world's z axis, for two worlds whose z is up, and translation
    SCALE = "scale"  # scale alone, about the world's origin


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
    check_same_length(estimate, truth)
    if kind is Alignment.NONE:
        return estimate
    p, q = estimate.positions_xyz, estimate.orientations_quat_wxyz
    if kind is Alignment.YAW:
        means = p.mean(axis=0), truth.positions_xyz.mean(axis=0)
        (x, y), (u, v) = (p - means[0]).T[:2], (truth.positions_xyz - means[1]).T[:2]
        R = Rotation.from_euler("z", np.arctan2(x @ v - y @ u, x @ u + y @ v)).as_matrix()
        t, s = means[1] - R @ means[0], 1.0
    else:
        R, t, s = umeyama(p, truth.positions_xyz, with_scale=kind is not Alignment.SE3)
    if kind is Alignment.SCALE:
        return Trajectory(estimate.timestamps_s, s * p, q)
    turned = Rotation.from_matrix(R) * Rotation.from_quat(q, scalar_first=True)
    return Trajectory(estimate.timestamps_s, s * p @ R.T + t, turned.as_quat(scalar_first=True))


def straightness(truth: Trajectory, residual_m: float = 0.0) -> str:
    """Why aligning to a path leaves the rotation about it open, or nothing.

    A path that hardly leaves a line fixes two angles; the third is what makes the errors of the positions smallest.
    `residual_m` is what is left of these errors after alignment, RMS.
    """
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(truth.positions_xyz.T)), 0))[::-1]
    if spread[1] > max(_STRAIGHT * spread[0], _RESIDUALS * residual_m):
        return ""
    return (
        f"the path is nearly straight ({spread[0]:.2g} m along, {spread[1]:.2g} m across, RMS): the rotation about it "
        "is hardly determined, and fitted; where z is up in both worlds, align by yaw"
    )
