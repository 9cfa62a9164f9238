"""The TUM trajectory format: a line a pose, ``timestamp tx ty tz qx qy qz qw``; note the order of the quaternion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray

from .text import drop_faults, number, pose_faults, read_rows, trajectory_of
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
        If the file is missing, holds no pose, or a line is not eight finite numbers or no pose.
    """
    return trajectory_of(path, tum_table(path))


def tum_table(path: Path, damaged: dict[int, str] | None = None) -> FloatArray:
    """Rows ``time x y z qw qx qy qz`` (n, 8) of a file.

    Parameters
    ----------
    path
        The file.
    damaged
        Takes up what is wrong with a pose, by its row, which holds NaN then. None refuses the file instead.
    """
    expected = "eight numbers 'timestamp tx ty tz qx qy qz qw'"
    rows = read_rows(path, lambda line: [number(f) for f in line.replace(",", " ").split()], 8, expected, damaged)
    rows = rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    drop_faults(rows, pose_faults(rows[:, 1:4], rows[:, 4:]), path, damaged)
    return rows
