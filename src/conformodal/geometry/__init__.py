"""Rotations, trajectories, cameras, bundle adjustment and trajectory errors: NumPy, SciPy and OpenCV only.

Invalid values raise :class:`PoseError`.
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
