"""The seven targets of a pose: position, and quaternion."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory, fix_sign

TARGET_NAMES = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")


def pose_targets(poses: Trajectory, sign_reference: FloatArray) -> FloatArray:
    """Targets (n, 7): metres, then the quaternion with the sign that `sign_reference` (4,) gives it."""
    return np.column_stack((poses.positions_xyz, fix_sign(poses.orientations_quat_wxyz, sign_reference)))
