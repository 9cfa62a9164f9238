"""Rotations, trajectories, cameras, file formats and trajectory errors. NumPy and SciPy only."""

from .camera import PinholeCamera
from .errors import PoseError, TrajectoryFileError
from .metrics import associate, orientation_errors_deg, position_errors_m, trajectory_errors
from .relative import MotionStatus, RelativeMotion
from .rotations import (
    angle_between_quats,
    check_rotation_matrices,
    fix_sign,
    matrix_from_quat_wxyz,
    normalise_quat,
    quat_wxyz_from_matrix,
    sign_reference,
)
from .trajectory import Trajectory
from .tum import read_tum, write_tum

__all__ = [
    "MotionStatus",
    "PinholeCamera",
    "PoseError",
    "RelativeMotion",
    "Trajectory",
    "TrajectoryFileError",
    "angle_between_quats",
    "associate",
    "check_rotation_matrices",
    "fix_sign",
    "matrix_from_quat_wxyz",
    "normalise_quat",
    "orientation_errors_deg",
    "position_errors_m",
    "quat_wxyz_from_matrix",
    "read_tum",
    "sign_reference",
    "trajectory_errors",
    "write_tum",
]
