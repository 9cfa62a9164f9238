"""The TUM trajectory format: a line a pose, ``timestamp tx ty tz qx qy qz qw``; note the order of the quaternion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .errors import PoseError, TrajectoryFileError
from .text import read_rows
from .trajectory import Trajectory

_HEADER = "# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)"


def tum_lines(trajectory: Trajectory) -> list[str]:
    """A line a pose; microseconds and micrometres survive the round trip."""
    q = trajectory.orientations_quat_wxyz
    rows = np.column_stack((trajectory.positions_xyz, q[:, 1:], q[:, :1]))
    stamped = zip(trajectory.timestamps_s.tolist(), rows.tolist(), strict=True)
    return [f"{time:.6f} {' '.join(f'{value:.9f}' for value in row)}" for time, row in stamped]


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, see :func:`tum_lines`."""
    path.write_text("\n".join([_HEADER, *tum_lines(trajectory)]) + "\n", encoding="utf-8")


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory.

    Raises
    ------
    TrajectoryFileError
        If the file is missing, holds no pose, or a line is not eight finite numbers.
    """
    expected = "eight numbers 'timestamp tx ty tz qx qy qz qw'"
    data = read_rows(path, lambda line: [float(field) for field in line.replace(",", " ").split()], 8, expected)
    try:
        return Trajectory(data[:, 0], data[:, 1:4], data[:, [7, 4, 5, 6]])
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc
