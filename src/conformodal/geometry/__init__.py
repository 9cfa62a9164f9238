"""Rotations, trajectories, cameras, file formats and trajectory errors. NumPy and SciPy only.

Invalid values raise :class:`PoseError`; files that cannot be read raise :class:`TrajectoryFileError`, which names the
file and the line.
"""

from .alignment import Alignment, align
from .camera import PinholeCamera
from .metrics import (
    associate,
    orientation_errors_deg,
    poses_at,
    position_errors_m,
    recall,
    relative_errors,
    trajectory_errors,
)
from .relative import MotionStatus, RelativeMotion, Submap
from .rotations import (
    PoseError,
    angle_between_quats,
    cross_matrices,
    fix_sign,
    matrix_from_quat_wxyz,
    normalise_quat,
    rigid_motions,
    sign_reference,
)
from .trajectory import Trajectory, concatenate
