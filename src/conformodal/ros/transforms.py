"""Rigid transforms and their messages: where odometry's frame lies in the map, and the camera that a base carries.

``T_a_b`` (4, 4) takes points from frame b to frame a.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory, cross_matrices, matrix_from_quat_wxyz, rigid_motions
from conformodal.localizer.mixtures import PoseMixture

from .conversion import RosError

# standard deviations of a hint that states none, those of a click in RViz
_HINT_M, _HINT_RAD = 0.5, float(np.radians(15))


def matrix_of(message: Any) -> FloatArray:
    """The matrix (4, 4) of a ``geometry_msgs/Transform`` or ``geometry_msgs/Pose``; RosError if it is not rigid."""
    if hasattr(message, "translation"):
        at, turn = message.translation, message.rotation
    else:
        at, turn = message.position, message.orientation
    values = np.array([at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z], dtype=np.float64)
    if not np.isfinite(values).all() or not values[3:].any():
        raise RosError(f"x y z, qw qx qy qz must be finite and a rotation, got {values.tolist()}")
    return rigid_motions(matrix_from_quat_wxyz(values[None, 3:])[0], values[:3])


def flattened(T: FloatArray) -> FloatArray:
    """The transform (4, 4) on the ground: x, y and the heading of the x axis; no height, no tilt."""
    heading = Rotation.from_rotvec([0, 0, np.arctan2(T[1, 0], T[0, 0])])
    return rigid_motions(heading.as_matrix(), T[:3, 3] * (1, 1, 0))


def map_from_odom(T_map_base: FloatArray, T_odom_base: FloatArray, *, planar: bool = False) -> FloatArray:
    """``T_map_odom`` (4, 4) that leads the odometry's base to where it is in the map; `planar`: both on the ground."""
    if planar:
        T_map_base, T_odom_base = flattened(T_map_base), flattened(T_odom_base)
    return T_map_base @ np.linalg.inv(T_odom_base)


def covariance_at(covariance: FloatArray, offset_xyz: FloatArray) -> FloatArray:
    """The covariance (6, 6) of a pose, for a point of the same body.

    `offset_xyz` (3,) leads to it, in the axes of the covariance, which are the world's: a rotation's error moves it.
    """
    moved = np.eye(6)
    moved[:3, 3:] = -cross_matrices(offset_xyz)
    return moved @ covariance @ moved.T


def hint_of(pose: Any, T_base_cam: FloatArray) -> PoseMixture:
    """The camera's pose, from a ``geometry_msgs/PoseWithCovariance`` of the base in the world, as one hypothesis.

    RViz leaves variances of what a click does not say at zero: height and tilt. The largest stated one of the same unit
    takes their place, or that of a click.
    """
    T_map_base = matrix_of(pose.pose)
    variances = np.diag(np.asarray(pose.covariance, dtype=np.float64).reshape(6, 6)).copy()
    if not (np.isfinite(variances).all() and (variances >= 0).all()):
        raise RosError(f"variances must be finite and at least 0, got {variances.tolist()}")
    for part, usual in ((variances[:3], _HINT_M**2), (variances[3:], _HINT_RAD**2)):
        part[part == 0] = part.max() or usual
    T_map_cam = T_map_base @ T_base_cam
    spread = np.diag(covariance_at(np.diag(variances), T_map_cam[:3, 3] - T_map_base[:3, 3]))
    camera = Trajectory.from_poses_se3([0.0], T_map_cam[None])
    return PoseMixture.weighted(
        camera.positions_xyz,
        np.sqrt(spread[None, :3]),
        camera.orientations_quat_wxyz,
        np.sqrt(spread[3:].max(keepdims=True)),
        np.zeros(1),
    )
