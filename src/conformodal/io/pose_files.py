"""Files with one pose per line, and what is wrong with a pose.

- TUM: ``timestamp tx ty tz qx qy qz qw``, with the scalar of the quaternion last; covariances may follow (OpenVINS).
- EuRoC: CSV of ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z``; further columns are ignored.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PoseError, Trajectory
from conformodal.geometry.metrics import in_seconds
from conformodal.geometry.poses import rotation_faults

from .errors import DatasetError
from .reading import number, numbers_in, parse_lines, read_lines, tokens, whole_number

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)"
Faults = dict[int, str]  # by row
# Farther away than any place, in metres: squares of larger numbers overflow.
_MOST_M = 1e9
_LENGTH_OFF = 0.01  # of a unit quaternion
_HEAD_LINES = 5
_LOST_STEPS, _LARGE = 10, 95  # from the identity to the poses around it, each as large as this percentile
_EUROC = 17  # numbers of a line, velocity and biases among them
# Numbers of TUM's lines with covariances: variances, those of the position, of both halves, half of (6, 6) or all.
_COVARIANCES = (14, 17, 20, 29, 44)
_COLUMN = re.compile(r"\bq(?:uat)?(?:[a-z_.]*[_.])?([wxyz])\b", re.IGNORECASE)


@dataclass(eq=False)
class PoseRows:
    """Rows of a file, ``x y z qw qx qy qz`` after a time where the format has one."""

    path: Path
    rows: FloatArray  # (n, 7) or (n, 8); a row without a sound pose holds NaN but for its time
    faults: Faults = field(default_factory=dict)  # why a row has no pose
    doubts: list[str] = field(default_factory=list)  # what is unlikely

    def drop(self, faults: Faults) -> None:
        """Take the poses of faulty rows away, and of those with NaN; refuse a file without a sound one."""
        missing = np.flatnonzero(~np.isfinite(self.rows).all(axis=1)).tolist()
        faults = dict.fromkeys(missing, "holds NaN or infinity") | faults
        self.faults = {i: f"{self.path}: pose {i} (counted from 0): {why}" for i, why in sorted(faults.items())}
        if len(faults) == len(self.rows):
            raise DatasetError(self.faults[0])
        self.rows[list(faults), -7:] = np.nan


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
    rows = table.rows[np.isfinite(table.rows).all(axis=1)]
    rows[:, 0], unit = in_seconds(rows[:, 0])
    if table.faults:
        table.doubts.append(f"{len(table.faults)} x left out, pose cannot be used: {table.faults[min(table.faults)]}")
    if unit:
        table.doubts.append(f"{path}: its times look like {unit}, and are read as such")
    for doubt in table.doubts:
        warnings.warn(doubt, stacklevel=2)
    try:
        return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    except PoseError as exc:
        raise DatasetError(f"{path}: {exc}") from exc


def tum_table(path: Path) -> PoseRows:
    """Rows with times (n, 8) of a file in TUM's format, or in EuRoC's, which has more columns and whole nanoseconds."""
    first = tokens(next((line for line in read_lines(path) if line.lstrip()[:1].isdigit()), ""))
    if len(first) == _EUROC and first[0].isdigit():
        table = euroc_table(path)
        table.doubts.append(f"{path}: has the poses of EuRoC's body, not of its camera; name the data set's folder")
        return table
    count = len(first) if len(first) in _COVARIANCES else 8

    def parse(line: str) -> list[float]:
        return numbers_in(line, count)[:8]

    return _timed(path, parse, f"{count} numbers 'timestamp tx ty tz qx qy qz qw'", "xyzw")


def euroc_table(path: Path) -> PoseRows:
    """Rows with times (n, 8) of a file in EuRoC's format; the poses are those of the body, not of a camera on it."""

    def parse(line: str) -> list[float]:
        values = tokens(line)
        return [whole_number(values[0]) / 1e9, *(number(values[k]) for k in range(1, 8))]

    return _timed(path, parse, "'timestamp [ns], x, y, z, qw, qx, qy, qz'", "wxyz")


def _timed(path: Path, parse: Callable[[str], list[float]], expected: str, order: str) -> PoseRows:
    """Rows (n, 8) with quaternions ``wxyz``, of a file that has them in an order unless its head names another."""
    table = PoseRows(path, np.array(parse_lines(path, parse, expected)))
    if not np.isfinite(table.rows[:, 0]).all():
        raise DatasetError(f"{path}: a time is not finite; correct or remove its line")
    if doubt := length_doubt(path, table.rows[:, 1:], 3):
        table.doubts.append(doubt)
    named = _quaternion_order(path) or order
    if named != order:
        table.doubts.append(f"{path}: its quaternions are read as {named}, as its head names them; usual is {order}")
    table.rows = rows = table.rows[:, [0, 1, 2, 3, *(4 + named.index(letter) for letter in "wxyz")]]
    lost = lost_faults(rows[:, 1:4], (rows[:, 1:] == (0, 0, 0, 1, 0, 0, 0)).all(axis=1))
    table.drop(pose_faults(rows[:, 1:4], rows[:, 4:]) | lost)
    return table


def _quaternion_order(path: Path) -> str:
    """The letters w, x, y, z in the order in which the head of a file names a quaternion's columns, or nothing."""
    for line in read_lines(path)[:_HEAD_LINES]:
        letters = "".join(_COLUMN.findall(line)).lower()
        if sorted(letters) == sorted("wxyz"):
            return letters
    return ""


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


def pose_faults(positions: FloatArray, quats: FloatArray) -> Faults:
    """Faults of positions (n, 3) and quaternions (n, 4); rows of NaN are left out."""
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.abs(positions).max(axis=1, initial=0.0) > _MOST_M
        length = np.linalg.norm(quats, axis=1)
        short = (length <= 1e-12) | np.isinf(length)
    faults = dict.fromkeys(np.flatnonzero(far).tolist(), f"its position is more than {_MOST_M:g} m away")
    return faults | dict.fromkeys(np.flatnonzero(short).tolist(), "its quaternion has no direction")


def lost_faults(positions: FloatArray, identity: BoolArray) -> Faults:
    """Faults of poses that are exactly the identity and far from those around: as of a lost camera."""
    # those at the start may be the origin of a path that goes on after a pause, as that of SLAM
    at, others = np.flatnonzero(identity), np.flatnonzero(~identity & (np.abs(positions) <= _MOST_M).all(axis=1))
    at = at[at > others[0]] if others.size else at[:0]
    steps = np.linalg.norm(np.diff(positions[others], axis=0), axis=1)
    if not at.size or not (steps > 0).any():
        return {}
    away = np.append(np.linalg.norm(positions[others], axis=1), np.inf)
    after = np.searchsorted(others, at)
    far = _LOST_STEPS * np.percentile(steps[steps > 0], _LARGE)  # not the median, which noise at rest makes small
    lost = at[np.minimum(away[after - 1], away[after]) > far].tolist()
    return dict.fromkeys(lost, "is the identity, and those around it are far away: was the camera lost?")


def matrix_faults(poses: FloatArray) -> Faults:
    """Faults of poses (n, 4, 4); rows of NaN are left out."""
    faults = pose_faults(poses[:, :3, 3], np.ones((len(poses), 4)))
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
