"""The KITTI trajectory format: a line a pose, the upper 3x4 of ``T_world_cam`` row by row, without timestamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray

from .errors import TrajectoryFileError
from .text import drop_faults, matrix_faults, number, read_rows, table_of, trajectory_of
from .trajectory import Trajectory

FRAME_RATE_HZ = 10.0


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; timestamps are lost."""
    np.savetxt(path, trajectory.poses_se3[:, :3].reshape(-1, 12), fmt="%.9e")


def read_kitti(path: Path, timestamps_s: npt.ArrayLike | None = None) -> Trajectory:
    """Read a trajectory.

    Parameters
    ----------
    path
        The file.
    timestamps_s
        (n,) seconds, one a line; by default frames at KITTI's 10 Hz.

    Raises
    ------
    TrajectoryFileError
        If the file is missing, holds no pose, a line is not twelve finite numbers or no rigid motion, or the number
        of timestamps is another.
    """
    table = kitti_table(path)
    times = np.arange(len(table)) / FRAME_RATE_HZ if timestamps_s is None else np.asarray(timestamps_s, dtype=float)
    if times.shape != (len(table),):
        raise TrajectoryFileError(f"{path}: holds {len(table)} poses, but {times.size} timestamps are given")
    return trajectory_of(path, np.column_stack((times, table)))


def kitti_table(path: Path, damaged: dict[int, str] | None = None) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of a file, see :func:`~conformodal.poses.tum.tum_table`."""
    rows = read_rows(path, lambda t: [number(f) for f in t.split()], 12, "twelve numbers", damaged, by_line=True)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    drop_faults(poses, matrix_faults(poses), path, damaged)
    return table_of(poses)
