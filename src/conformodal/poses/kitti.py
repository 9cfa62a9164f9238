"""The KITTI trajectory format: a line a pose, the upper 3x4 of ``T_world_cam`` row by row, without timestamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from .errors import PoseError, TrajectoryFileError
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
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise TrajectoryFileError(f"{path}: cannot be read as a KITTI trajectory: {exc}") from exc
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = [float(field) for field in line.split()]
        except ValueError:
            row = []
        if len(row) != 12 or not np.isfinite(row).all():
            raise TrajectoryFileError(f"{path}, line {number}: expected twelve numbers, got {line[:80]!r}")
        rows.append(row)
    if not rows:
        raise TrajectoryFileError(f"{path}: holds no pose; expected lines of twelve numbers")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.array(rows).reshape(-1, 3, 4)
    times = np.arange(len(rows)) / FRAME_RATE_HZ if timestamps_s is None else np.asarray(timestamps_s, dtype=np.float64)
    if times.shape != (len(rows),):
        raise TrajectoryFileError(f"{path}: holds {len(rows)} poses, but {times.size} timestamps are given")
    try:
        return Trajectory.from_poses_se3(times, poses)
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc
