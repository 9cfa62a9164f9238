"""The KITTI trajectory format: a line a pose, the upper 3x4 of ``T_world_cam`` row by row, without timestamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from .errors import PoseError, TrajectoryFileError
from .text import read_rows
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
    rows = read_rows(path, lambda line: [float(field) for field in line.split()], 12, "twelve numbers")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    times = np.arange(len(rows)) / FRAME_RATE_HZ if timestamps_s is None else np.asarray(timestamps_s, dtype=np.float64)
    if times.shape != (len(rows),):
        raise TrajectoryFileError(f"{path}: holds {len(rows)} poses, but {times.size} timestamps are given")
    try:
        return Trajectory.from_poses_se3(times, poses)
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc
