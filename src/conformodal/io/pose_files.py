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
from conformodal.geometry.rotations import rigid_motions
from conformodal.geometry.trajectory import Trajectory

from .pose_text import (
    drop_faults,
    fractions_of,
    length_doubt,
    lost_faults,
    matrix_faults,
    nanoseconds,
    number,
    pose_faults,
    quaternion_order,
    read_rows,
    table_of,
    trajectory_of,
)

FRAME_RATE_HZ = 10.0  # of KITTI
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
    rows = tum_table(path, damaged)
    if damaged:
        warnings.warn(f"{len(damaged)} x left out, pose cannot be used: {damaged[min(damaged)]}", stacklevel=2)
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows[:, 0], unit = in_seconds(rows[:, 0])
    if unit:
        warnings.warn(f"{path}: its times look like {unit}, and are read as such", stacklevel=2)
    return trajectory_of(path, rows)


def tum_table(path: Path, damaged: dict[int, str] | None = None, doubts: list[str] | None = None) -> FloatArray:
    """Rows ``time x y z qw qx qy qz`` (n, 8) of a file; for `damaged` see :func:`~conformodal.io.pose_text.read_rows`.

    `doubts` takes up what is unlikely; None warns of it.
    """
    expected = "eight numbers 'timestamp tx ty tz qx qy qz qw'"
    stamps: list[str] = []

    def parse(line: str) -> list[float]:
        row = _numbers(line)
        if len(row) == 8 and np.isfinite(row[0]):
            stamps.append(_fields(line)[0])
        return row

    rows = read_rows(path, parse, 8, expected, damaged)
    told, there = "", np.isfinite(rows[:, 0])
    numbers = fractions_of(stamps, in_order=True) if len(stamps) == there.sum() else None
    if numbers is not None and (rows[there, 0] >= 0).all():
        rows[there, 0], told = numbers
    return _checked(rows, "xyzw", path, damaged, doubts, told)


def _numbers(line: str) -> list[float]:
    return [number(field) for field in _fields(line)]


def _checked(
    rows: FloatArray,
    order: str,
    path: Path,
    damaged: dict[int, str] | None,
    doubts: list[str] | None,
    told: str = "",
) -> FloatArray:
    """Rows (n, 8) with ``wxyz`` and without faulty poses, which keep their times; tells doubts of lengths and order."""
    found = [f"{path}: {told}"] if told else []
    found += [doubt] if (doubt := length_doubt(path, rows[:, 1:], 3)) else []
    named = quaternion_order(path) or order
    if named != order:
        found.append(f"{path}: its quaternions are read as {named}, as its head names them; usual is {order}")
    rows = rows[:, [0, 1, 2, 3, *(4 + named.index(letter) for letter in "wxyz")]]
    faults = pose_faults(rows[:, 1:4], rows[:, 4:])
    faults |= lost_faults(rows[:, 1:4], (rows[:, 1:] == (0, 0, 0, 1, 0, 0, 0)).all(axis=1))
    drop_faults(rows[:, 1:], faults, path, damaged)
    if doubts is not None:
        doubts += found
    else:
        for doubt in found:
            warnings.warn(doubt, stacklevel=4)
    return rows


def read_kitti(path: Path) -> Trajectory:
    """Read a trajectory of frames at KITTI's 10 Hz."""
    table = kitti_table(path)
    return trajectory_of(path, np.column_stack((np.arange(len(table)) / FRAME_RATE_HZ, table)))


def kitti_table(path: Path, damaged: dict[int, str] | None = None) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of a file, as :func:`tum_table`."""
    rows = read_rows(path, _upper_rows, 12, "twelve numbers", damaged, by_line=True)
    upper = rows.reshape(-1, 3, 4)
    poses = rigid_motions(upper[:, :, :3], upper[:, :, 3])
    drop_faults(poses, matrix_faults(poses), path, damaged)
    return table_of(poses)


def _upper_rows(line: str) -> list[float]:
    """Of a whole matrix, the upper three rows."""
    found = _numbers(line)
    return found[:12] if found[12:] == [0, 0, 0, 1] else found


def read_euroc(path: Path) -> Trajectory:
    """Read a trajectory; columns after the eighth (velocity, biases) are left out.

    The poses are those of the body that the file is about, not of a camera on it.
    """
    return trajectory_of(path, euroc_table(path))


def euroc_table(path: Path, damaged: dict[int, str] | None = None, doubts: list[str] | None = None) -> FloatArray:
    """As :func:`tum_table`, of EuRoC's format."""
    rows = read_rows(path, _parse_euroc, 8, "'timestamp [ns], x, y, z, qw, qx, qy, qz'", damaged)
    return _checked(rows, "wxyz", path, damaged, doubts)


def _fields(line: str) -> list[str]:
    """What stands between commas, or semicolons, or blanks: one of them separates a line."""
    separator = next((mark for mark in ",;" if mark in line), None)
    return [field.strip() for field in line.strip().removesuffix(separator or "").split(separator)]


def _parse_euroc(line: str) -> list[float]:
    fields = _fields(line)[:8]
    return [nanoseconds(fields[0].strip()) / 1e9, *(number(field) for field in fields[1:])]
