"""Files with one pose per line, and what is wrong with a pose.

- TUM: ``timestamp tx ty tz qx qy qz qw``, with the scalar of the quaternion last.
- KITTI: the upper 3x4 of ``T_world_cam`` row by row, without timestamps.
- EuRoC: CSV of ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z``; further columns are ignored.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PoseError, Trajectory, rigid_motions
from conformodal.geometry.metrics import in_seconds
from conformodal.geometry.poses import rotation_faults

from .errors import DatasetError
from .reading import number, numbers_in, parse_lines, read_lines, tokens, whole_number

KITTI_RATE_HZ = 10.0
TUM_HEADER = "# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)"
# Farther away than any place, in metres: squares of larger numbers overflow.
_MOST_M = 1e9
_LENGTH_OFF = 0.01  # of a unit quaternion
_HEAD_LINES = 5
_LOST_STEPS, _LARGE = 10, 95  # from the identity to the poses around it, each as large as this percentile
_COLUMN = re.compile(r"\bq(?:uat)?(?:[a-z_.]*[_.])?([wxyz])\b", re.IGNORECASE)
# Fractions of seconds that are whole micro- or nanoseconds without the zeros before them: digits, and how many tell it.
_UNPADDED_DIGITS, _UNPADDED_LEAST = (6, 9), 30


@dataclass(eq=False)
class PoseRows:
    """Rows of a file, ``x y z qw qx qy qz`` after a time where the format has one.

    Attributes
    ----------
    rows
        (n, 7) or (n, 8). A damaged row holds NaN but for its time.
    damaged
        What is wrong with a row, by its number.
    doubts
        What is unlikely.
    """

    path: Path
    rows: FloatArray
    damaged: dict[int, str] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)

    def drop(self, faults: dict[int, str]) -> None:
        """Note faulty poses as damaged, and refuse a file without a sound one."""
        lines = {i: f"{self.path}: pose {i} (counted from 0): {why}" for i, why in faults.items()}
        self.damaged = lines | self.damaged
        if lines and len(self.damaged) == len(self.rows):
            raise DatasetError(lines[min(lines)])
        self.rows[list(lines), -7:] = np.nan


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
    table = tum_table(path)
    doubts, rows = table.doubts, table.rows[np.isfinite(table.rows).all(axis=1)]
    if table.damaged:
        first = table.damaged[min(table.damaged)]
        doubts.append(f"{len(table.damaged)} x left out, pose cannot be used: {first}")
    rows[:, 0], unit = in_seconds(rows[:, 0])
    if unit:
        doubts.append(f"{path}: its times look like {unit}, and are read as such")
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=2)
    try:
        return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    except PoseError as exc:
        raise DatasetError(f"{path}: {exc}") from exc


def tum_table(path: Path) -> PoseRows:
    """Rows with times (n, 8) of a file in TUM's format."""
    stamps: list[str] = []

    def parse(line: str) -> list[float]:
        row = numbers_in(line)
        stamps.append(tokens(line)[0])
        return row

    table = read_rows(path, parse, 8, "eight numbers 'timestamp tx ty tz qx qy qz qw'")
    if doubt := unpadded_doubt(stamps):
        table.doubts.append(f"{path}: {doubt}")
    return _checked(table, "xyzw")


def euroc_table(path: Path) -> PoseRows:
    """Rows with times (n, 8) of a file in EuRoC's format; the poses are those of the body, not of a camera on it."""

    def parse(line: str) -> list[float]:
        time, *pose = tokens(line)[:8]
        return [whole_number(time) / 1e9, *map(number, pose)]

    return _checked(read_rows(path, parse, 8, "'timestamp [ns], x, y, z, qw, qx, qy, qz'"), "wxyz")


def kitti_table(path: Path) -> PoseRows:
    """Rows (n, 7) of a file in KITTI's format."""
    table = read_rows(path, numbers_in, 12, "twelve numbers", by_line=True)
    upper = table.rows.reshape(-1, 3, 4)
    poses = rigid_motions(upper[:, :, :3], upper[:, :, 3])
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    table.rows = table_of(poses)
    table.drop(faults)
    return table


def _checked(table: PoseRows, order: str) -> PoseRows:
    """Rows (n, 8) with ``wxyz`` and without faulty poses, which keep their times; tells doubts of lengths and order."""
    path = table.path
    if doubt := length_doubt(path, table.rows[:, 1:], 3):
        table.doubts.append(doubt)
    named = _quaternion_order(path) or order
    if named != order:
        table.doubts.append(f"{path}: its quaternions are read as {named}, as its head names them; usual is {order}")
    table.rows = rows = table.rows[:, [0, 1, 2, 3, *(4 + named.index(letter) for letter in "wxyz")]]
    faults = pose_faults(rows[:, 1:4], rows[:, 4:])
    table.drop(faults | lost_faults(rows[:, 1:4], (rows[:, 1:] == (0, 0, 0, 1, 0, 0, 0)).all(axis=1)))
    return table


def _quaternion_order(path: Path) -> str:
    """The letters w, x, y, z in the order in which the head of a file names a quaternion's columns, or nothing."""
    for line in read_lines(path)[:_HEAD_LINES]:
        letters = "".join(_COLUMN.findall(line)).lower()
        if sorted(letters) == sorted("wxyz"):
            return letters
    return ""


def unpadded_doubt(texts: Sequence[str]) -> str:
    """Why fractions of seconds may be whole nanoseconds without the zeros before them, as 12.5000 for 5000 ns."""
    fractions = [text.partition(".")[2] for text in texts]
    longest = max(map(len, fractions), default=0)
    of_one_length = min(map(len, fractions), default=0) == longest
    if len(fractions) < _UNPADDED_LEAST or of_one_length or longest not in _UNPADDED_DIGITS:
        return ""
    if any(fraction[:1] == "0" < fraction for fraction in fractions):
        return ""
    shortest = min(texts, key=len)
    return f"its times are read as decimals, such as {shortest}, and no fraction begins with 0: were zeros left out?"


def read_rows(
    path: Path, parse: Callable[[str], list[float]], width: int, expected: str, *, by_line: bool = False
) -> PoseRows:
    """Rows (n, width) of a file; it is refused if most lines do not hold `width` numbers, or all are damaged.

    `expected` is what a line should be, for messages; for the others see :func:`~conformodal.io.reading.parse_lines`.
    """

    def parse_row(line: str) -> list[float]:
        row = parse(line)
        if len(row) != width:
            raise ValueError(f"{len(row)} numbers")
        return row

    lines = parse_lines(path, parse_row, by_line=by_line)
    if not lines:
        raise DatasetError(f"{path}: holds no pose; expected lines of {expected}")
    rows = np.array([[np.nan] * width if line.value is None else line.value for line in lines])
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
    rows[bad, 0 if by_line else 1 :] = np.nan
    damaged = {i: lines[i].fault(expected) for i in bad}
    if len(bad) == len(rows) or 2 * sum(line.value is None for line in lines) > len(rows):
        raise DatasetError(damaged[bad[0]])
    return PoseRows(path, rows, damaged)


def length_doubt(path: Path, values: FloatArray, at: int) -> str:
    """What is wrong with the lengths of quaternions, the columns `at` to `at` + 3 of poses (n, 7), or nothing.

    Where other columns have unit length, the order is likely another.
    """
    with np.errstate(over="ignore"):
        lengths = np.array([np.linalg.norm(values[:, k : k + 4], axis=1) for k in range(4)])
    off = np.flatnonzero((np.abs(lengths[at] - 1) > _LENGTH_OFF) & (lengths[at] > 0))
    if not off.size:
        return ""
    apart = np.nanmedian(np.abs(lengths - 1), axis=1)
    best = int(np.argmin(apart))
    order = f"; columns {best + 1} to {best + 4} of the pose have unit length: is the order another?"
    return (
        f"{path}: pose {off[0]} (counted from 0) has a quaternion of length {lengths[at, off[0]]:.4g}, expected 1; so "
        f"have {off.size} of {len(values)}; they are normalised{order if apart[best] < 1e-3 and best != at else ''}"
    )


def pose_faults(positions: FloatArray, quats: FloatArray) -> dict[int, str]:
    """Faults of positions (n, 3) and quaternions (n, 4), by row; rows of NaN are left out."""
    faults = {}
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.abs(positions).max(axis=1, initial=0.0) > _MOST_M
        length = np.linalg.norm(quats, axis=1)
        short = (length <= 1e-12) | np.isinf(length)
    for i in np.flatnonzero(far).tolist():
        faults[i] = f"its position {positions[i].tolist()} is more than {_MOST_M:g} m away"
    for i in np.flatnonzero(short).tolist():
        faults[i] = f"its quaternion {quats[i].tolist()} has no direction"
    return faults


def lost_faults(positions: FloatArray, identity: BoolArray) -> dict[int, str]:
    """Faults of poses that are exactly the identity and far from those around: as of a lost camera."""
    at, others = np.flatnonzero(identity), np.flatnonzero(~identity & (np.abs(positions) <= _MOST_M).all(axis=1))
    steps = np.linalg.norm(np.diff(positions[others], axis=0), axis=1)
    if not at.size or not (steps > 0).any():
        return {}
    away = np.concatenate(([np.inf], np.linalg.norm(positions[others], axis=1), [np.inf]))
    after = np.searchsorted(others, at)
    far = _LOST_STEPS * np.percentile(steps[steps > 0], _LARGE)  # not the median, which noise at rest makes small
    extent = np.linalg.norm(np.ptp(positions[others], axis=0))
    # a path may begin at the identity and go on after a pause, as that of SLAM, which needs a baseline first
    lost = np.minimum(away[after], away[after + 1]) > np.where(after == 0, max(far, extent), far)
    why = "is the identity, and those around it are far away: was the camera lost?"
    return dict.fromkeys(at[lost].tolist(), why)


def matrix_faults(poses: FloatArray) -> dict[int, str]:
    """Faults of poses (n, 4, 4), by row; rows of NaN are left out."""
    n = len(poses)
    faults = pose_faults(poses[:, :3, 3], np.tile([1.0, 0, 0, 0], (n, 1)))
    finite = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    faults |= {int(finite[i]): f"is {why}" for i, why in rotation_faults(poses[finite, :3, :3]).items()}
    for i in finite[np.abs(poses[finite, 3] - (0, 0, 0, 1)).max(axis=1, initial=0.0) > 1e-6].tolist():
        hint = "; is it transposed?" if np.allclose(poses[i, :, 3], (0, 0, 0, 1), atol=1e-6) else ""
        faults[i] = f"its last row is {poses[i, 3].tolist()}, expected [0.0, 0.0, 0.0, 1.0]{hint}"
    return faults | lost_faults(poses[:, :3, 3], (poses == np.eye(4)).all(axis=(1, 2)))


def table_of(poses: FloatArray) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of poses (n, 4, 4); NaN where a pose is NaN."""
    rows = np.full((len(poses), 7), np.nan)
    finite = np.isfinite(poses).all(axis=(1, 2))
    if finite.any():
        path = Trajectory.from_poses_se3(np.zeros(int(finite.sum())), poses[finite])
        rows[finite] = np.column_stack((path.positions_xyz, path.orientations_quat_wxyz))
    return rows


def matrices_of(rows: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of rows ``x y z qw qx qy qz`` (n, 7); NaN where a row is."""
    poses = np.full((len(rows), 4, 4), np.nan)
    finite = np.isfinite(rows).all(axis=1)
    path = Trajectory(np.zeros(int(finite.sum())), rows[finite, :3], rows[finite, 3:])
    poses[finite] = path.poses_se3 if len(path) else poses[finite]
    return poses
