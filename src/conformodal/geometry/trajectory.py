"""Timestamps and camera poses along a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import BoolArray, FloatArray

from .rotations import (
    PoseError,
    check_rotation_matrices,
    matrix_from_quat_wxyz,
    normalise_quat,
    quat_wxyz_from_matrix,
    rigid_motions,
)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera-to-world poses over time.

    Parameters
    ----------
    timestamps_s
        (n,) seconds.
    positions_xyz
        (n, 3) metres, the camera centre in the world.
    orientations_quat_wxyz
        (n, 4), rotating camera coordinates (x right, y down, z forward) to world; normalised here.

    Raises
    ------
    PoseError
        If shapes differ or a value is not finite.

    Examples
    --------
    >>> from conformodal import Trajectory
    >>> path = Trajectory([0.0, 0.1], [[0, 0, 0], [1, 0, 0]], [[1, 0, 0, 0], [2, 0, 0, 0]])
    >>> path.orientations_quat_wxyz[1]  # of unit length, w first
    array([1., 0., 0., 0.])
    >>> len(path[1:])
    1
    """

    timestamps_s: FloatArray
    positions_xyz: FloatArray
    orientations_quat_wxyz: FloatArray

    def __post_init__(self) -> None:
        times = np.asarray(self.timestamps_s, dtype=np.float64)
        if times.ndim != 1 or not np.isfinite(times).all():
            raise PoseError(f"timestamps_s must be finite and of shape (n,), got {times.shape}: {times.ravel()[:3]}")
        n = len(times)
        for name, width in (("positions_xyz", 3), ("orientations_quat_wxyz", 4)):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.shape != (n, width):
                raise PoseError(f"{name} must have shape ({n}, {width}) to fit the timestamps, got {array.shape}")
            if not np.isfinite(array).all():
                raise PoseError(f"{name} holds NaN or infinity in row {int(np.argwhere(~np.isfinite(array))[0][0])}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "timestamps_s", times)
        object.__setattr__(self, "orientations_quat_wxyz", normalise_quat(self.orientations_quat_wxyz))

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def __getitem__(self, index: slice | npt.NDArray[np.integer] | BoolArray) -> Trajectory:
        return Trajectory(self.timestamps_s[index], self.positions_xyz[index], self.orientations_quat_wxyz[index])

    @classmethod
    def from_poses_se3(cls, timestamps_s: npt.ArrayLike, poses_se3: npt.ArrayLike) -> Trajectory:
        """From 4x4 matrices ``T_world_cam`` (n, 4, 4)."""
        poses = np.asarray(poses_se3, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise PoseError(f"poses_se3 must have shape (n, 4, 4), got {poses.shape}")
        rotations = check_rotation_matrices(poses[:, :3, :3], "pose")
        return cls(np.asarray(timestamps_s, dtype=np.float64), poses[:, :3, 3], quat_wxyz_from_matrix(rotations))

    @property
    def poses_se3(self) -> FloatArray:
        """4x4 matrices ``T_world_cam``, (n, 4, 4)."""
        return rigid_motions(matrix_from_quat_wxyz(self.orientations_quat_wxyz), self.positions_xyz)


def concatenate(parts: Sequence[Trajectory]) -> Trajectory:
    """One trajectory from several, in order."""
    return Trajectory(
        np.concatenate([part.timestamps_s for part in parts]),
        np.concatenate([part.positions_xyz for part in parts]),
        np.concatenate([part.orientations_quat_wxyz for part in parts]),
    )
