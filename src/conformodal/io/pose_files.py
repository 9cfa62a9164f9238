"""The formats of TUM, KITTI and EuRoC, one pose per line.

- TUM: ``timestamp tx ty tz qx qy qz qw``, with the scalar of the quaternion last.
- KITTI: the upper 3x4 of ``T_world_cam`` row by row, without timestamps.
- EuRoC: CSV of ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z``; further columns are ignored.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry.metrics import in_seconds
from conformodal.geometry.rotations import PoseError, rigid_motions
from conformodal.geometry.trajectory import Trajectory

from .pose_text import (
    TrajectoryFileError,
    drop_faults,
    length_doubt,
    lost_faults,
    matrix_faults,
    number,
    numbers_in,
    pose_faults,
    quaternion_order,
    read_rows,
    table_of,
    tokens,
    unpadded_doubt,
    whole_number,
)

KITTI_RATE_HZ = 10.0
TUM_HEADER = "# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)"


def tum_lines(trajectory: Trajectory) -> list[str]:
    """One line per pose; microseconds and micrometres survive the round trip."""
    q = trajectory.orientations_quat_wxyz
    rows = np.column_stack((trajectory.positions_xyz, q[:, 1:], q[:, :1]))
    stamped = zip(trajectory.timestamps_s.tolist(), rows.tolist(), strict=True)
    return [f"{time:.6f} {' '.join(f'{value:.9f}' for value in row)}" for time, row in stamped]


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, see :func:`tum_lines`."""
    path.write_text("\n".join([TUM_HEADER, *tum_lines(trajectory)]) + "\n", encoding="utf-8")


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory; warns of rows without a pose, which are left out, and of quaternions not of unit length."""
    damaged: dict[int, str] = {}
    doubts: list[str] = []
    rows = tum_table(path, damaged, doubts)
    if damaged:
        doubts.append(f"{len(damaged)} x left out, pose cannot be used: {damaged[min(damaged)]}")
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows[:, 0], unit = in_seconds(rows[:, 0])
    if unit:
        doubts.append(f"{path}: its times look like {unit}, and are read as such")
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=2)
    return _trajectory(path, rows)


def tum_table(path: Path, damaged: dict[int, str] | None, doubts: list[str]) -> FloatArray:
    """Rows ``time x y z qw qx qy qz`` (n, 8) of a file; for `damaged` see :func:`~conformodal.io.pose_text.read_rows`.

    `doubts` takes up what is unlikely.
    """
    stamps: list[str] = []

    def parse(line: str) -> list[float]:
        row = numbers_in(line)
        stamps.append(tokens(line)[0])
        return row

    rows = read_rows(path, parse, 8, "eight numbers 'timestamp tx ty tz qx qy qz qw'", damaged)
    if doubt := unpadded_doubt(stamps):
        doubts.append(f"{path}: {doubt}")
    return _checked(rows, "xyzw", path, damaged, doubts)


def _checked(rows: FloatArray, order: str, path: Path, damaged: dict[int, str] | None, doubts: list[str]) -> FloatArray:
    """Rows (n, 8) with ``wxyz`` and without faulty poses, which keep their times; tells doubts of lengths and order."""
    if doubt := length_doubt(path, rows[:, 1:], 3):
        doubts.append(doubt)
    named = quaternion_order(path) or order
    if named != order:
        doubts.append(f"{path}: its quaternions are read as {named}, as its head names them; usual is {order}")
    rows = rows[:, [0, 1, 2, 3, *(4 + named.index(letter) for letter in "wxyz")]]
    faults = pose_faults(rows[:, 1:4], rows[:, 4:])
    faults |= lost_faults(rows[:, 1:4], (rows[:, 1:] == (0, 0, 0, 1, 0, 0, 0)).all(axis=1))
    drop_faults(rows[:, 1:], faults, path, damaged)
    return rows


def read_kitti(path: Path) -> Trajectory:
    """Read a trajectory of frames at KITTI's 10 Hz."""
    table = kitti_table(path)
    return _trajectory(path, np.column_stack((np.arange(len(table)) / KITTI_RATE_HZ, table)))


def kitti_table(path: Path, damaged: dict[int, str] | None = None) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of a file, as :func:`tum_table`."""
    rows = read_rows(path, numbers_in, 12, "twelve numbers", damaged, by_line=True)
    upper = rows.reshape(-1, 3, 4)
    poses = rigid_motions(upper[:, :, :3], upper[:, :, 3])
    drop_faults(poses, matrix_faults(poses), path, damaged)
    return table_of(poses)


def read_euroc(path: Path) -> Trajectory:
    """Read a trajectory; columns after the eighth (velocity, biases) are left out.

    The poses are those of the body that the file is about, not of a camera on it.
    """
    return _trajectory(path, euroc_table(path, None, []))


def euroc_table(path: Path, damaged: dict[int, str] | None, doubts: list[str]) -> FloatArray:
    """As :func:`tum_table`, of EuRoC's format."""

    def parse(line: str) -> list[float]:
        time, *pose = tokens(line)[:8]
        return [whole_number(time) / 1e9, *map(number, pose)]

    rows = read_rows(path, parse, 8, "'timestamp [ns], x, y, z, qw, qx, qy, qz'", damaged)
    return _checked(rows, "wxyz", path, damaged, doubts)


def _trajectory(path: Path, rows: FloatArray) -> Trajectory:
    """The trajectory of rows ``time x y z qw qx qy qz`` (n, 8)."""
    try:
        return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc
