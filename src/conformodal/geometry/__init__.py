"""Rotations, trajectories, cameras, bundle adjustment and trajectory errors: NumPy, SciPy and OpenCV only.

Invalid values raise :class:`PoseError`.
"""

from .camera import PinholeCamera
from .metrics import (
    Alignment,
    align,
    orientation_errors_deg,
    poses_at,
    position_errors_m,
    relative_errors,
    trajectory_errors,
)
from .poses import (
    TARGET_NAMES,
    MotionStatus,
    Pose,
    PoseError,
    RelativeMotion,
    Submap,
    Trajectory,
    angle_between_quats,
    concatenate,
    cross_matrices,
    fix_sign,
    matrix_from_quat_wxyz,
    normalise_quat,
    pose_targets,
    rigid_motions,
    sign_reference,
)
