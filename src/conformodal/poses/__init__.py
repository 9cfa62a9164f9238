"""Rotations, trajectories, cameras, file formats and trajectory errors. NumPy and SciPy only.

Invalid values raise :class:`PoseError`; files that cannot be read raise :class:`TrajectoryFileError`, which names the
file and the line.
"""

from .alignment import Alignment, align, umeyama
from .camera import PinholeCamera
from .errors import PoseError, TrajectoryFileError
from .formats import read_euroc, read_kitti, read_tum, tum_lines, write_euroc, write_kitti, write_tum
from .metrics import (
    KittiDrift,
    associate,
    kitti_drift,
    orientation_errors_deg,
    poses_at,
    position_errors_m,
    recall,
    relative_errors,
    trajectory_errors,
)
from .relative import MotionStatus, RelativeMotion, Submap
from .rotations import (
    angle_between_quats,
    check_rotation_matrices,
    fix_sign,
    matrix_from_quat_wxyz,
    normalise_quat,
    quat_wxyz_from_matrix,
    sign_reference,
)
from .trajectory import Trajectory, concatenate

__all__ = [
    "Alignment",
    "KittiDrift",
    "MotionStatus",
    "PinholeCamera",
    "PoseError",
    "RelativeMotion",
    "Submap",
    "Trajectory",
    "TrajectoryFileError",
    "align",
    "angle_between_quats",
    "associate",
    "check_rotation_matrices",
    "concatenate",
    "fix_sign",
    "kitti_drift",
    "matrix_from_quat_wxyz",
    "normalise_quat",
    "orientation_errors_deg",
    "poses_at",
    "position_errors_m",
    "quat_wxyz_from_matrix",
    "read_euroc",
    "read_kitti",
    "read_tum",
    "recall",
    "relative_errors",
    "sign_reference",
    "trajectory_errors",
    "tum_lines",
    "umeyama",
    "write_euroc",
    "write_kitti",
    "write_tum",
]
