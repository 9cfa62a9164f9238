"""Files with one pose per line, and what is wrong with a pose.

- TUM: ``timestamp tx ty tz qx qy qz qw``, with the scalar of the quaternion last; covariances may follow (OpenVINS),
  and a head that names all columns has its own.
- EuRoC: CSV of ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z``; further columns are ignored.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PoseError, Trajectory
from conformodal.geometry.poses import rotation_faults

from .diagnosis.clocks import in_seconds
from .diagnosis.columns import has_decimal_commas, length_doubt, named_columns, quaternion_order, with_decimal_points
from .errors import DatasetError
from .reading import number, numbers_in, parse_lines, read_lines, tokens, whole_number

TUM_HEADER = "# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)"
Faults = dict[int, str]  # by row
# Farther away than any place, in metres: squares of larger numbers overflow.
_MAX_M = 1e9
_HEAD_LINES = 5
_LOST_STEPS, _LARGE = 10, 95  # from the identity to the poses around it, each as large as this percentile
_EUROC = 17  # numbers of a line, velocity and biases among them
# Numbers of TUM's lines with covariances: variances, those of the position, of both halves, half of (6, 6) or all.
_COVARIANCES = (14, 17, 20, 29, 44)


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
    """Rows with times (n, 8) of a file in TUM's format, with columns as its head names them, or in EuRoC's."""
    heads, first = _head_and_first(path)
    commas = has_decimal_commas(first)
    values = tokens(with_decimal_points(first) if commas else first)
    if len(values) == _EUROC and values[0].isdigit():  # whole nanoseconds
        table = euroc_table(path)
        table.doubts.append(f"{path}: has the poses of EuRoC's body, not of its camera; name the data set's folder")
        return table
    columns = named_columns(path, heads, len(values))
    count = len(values) if len(values) in _COVARIANCES else 8

    def parse(line: str) -> list[float]:
        text = with_decimal_points(line) if commas else line
        return numbers_in(text, count)[:8] if columns is None else columns.parse(text)

    if columns is not None:
        table = _timed(path, parse, f"{len(columns.names)} numbers '{' '.join(columns.names)}'", "xyzw")
        if columns.order != "xyzw":
            table.doubts.append(_named_order(path, columns.order, "xyzw"))
    else:
        order = quaternion_order(heads) or "xyzw"
        table = _timed(path, parse, _expected(path, heads, values, count), order)
        if order != "xyzw":
            table.doubts.append(_named_order(path, order, "xyzw"))
    if commas:
        table.doubts.append(f"{path}: its commas are read as decimal marks")
    return table


def euroc_table(path: Path) -> PoseRows:
    """Rows with times (n, 8) of a file in EuRoC's format; the poses are those of the body, not of a camera on it."""

    def parse(line: str) -> list[float]:
        values = tokens(line)
        return [whole_number(values[0]) / 1e9, *(number(values[k]) for k in range(1, 8))]

    order = quaternion_order(_head_and_first(path)[0]) or "wxyz"
    table = _timed(path, parse, "'timestamp [ns], x, y, z, qw, qx, qy, qz'", order)
    if order != "wxyz":
        table.doubts.append(_named_order(path, order, "wxyz"))
    return table


def _named_order(path: Path, order: str, usual: str) -> str:
    return f"{path}: its quaternions are read as {order}, as its head names them; usual is {usual}"


def _head_and_first(path: Path) -> tuple[list[str], str]:
    """The lines before the first one of numbers, at most five, and that one."""
    lines = [line for line in read_lines(path) if line.strip()]
    at = next((k for k, line in enumerate(lines) if line.lstrip()[0] in "+-.0123456789"), len(lines))
    for k in range(
        min(_HEAD_LINES, len(lines) - 1) if at == len(lines) else 0
    ):  # lines begin with the name of an image
        if named_columns(path, [lines[k]], len(tokens(lines[k + 1]))) is not None:
            at = k + 1
            break
    return lines[:at][-_HEAD_LINES:], (lines[at] if at < len(lines) else "")


def _expected(path: Path, heads: list[str], values: list[str], count: int) -> str:
    """What a line should be, and what to do where it has other columns."""
    expected = f"{count} numbers 'timestamp tx ty tz qx qy qz qw'"
    if len(values) <= count:
        return expected
    head = next((line.strip()[:80] for line in reversed(heads) if len(tokens(line)) >= len(values)), "")
    names = f", where it has {head!r}" if head else ""
    further = f"{len(values)} columns{names}; name all columns in the line before the first pose, such as"
    return f"{expected}, or a head that names its {further} '# timestamp id x y z qx qy qz qw'"


def _timed(path: Path, parse: Callable[[str], list[float]], expected: str, order: str) -> PoseRows:
    """Rows (n, 8) with quaternions ``wxyz``, of a file that has them in an order."""
    table = PoseRows(path, np.array(parse_lines(path, parse, expected)))
    if not np.isfinite(table.rows[:, 0]).all():
        raise DatasetError(f"{path}: a time is not finite; correct or remove its line")
    if doubt := length_doubt(path, table.rows[:, 1:], 3):
        table.doubts.append(doubt)
    table.rows = rows = table.rows[:, [0, 1, 2, 3, *(4 + order.index(letter) for letter in "wxyz")]]
    lost = lost_faults(rows[:, 1:4], (rows[:, 1:] == (0, 0, 0, 1, 0, 0, 0)).all(axis=1))
    table.drop(pose_faults(rows[:, 1:4], rows[:, 4:]) | lost)
    return table


def pose_faults(positions: FloatArray, quats: FloatArray) -> Faults:
    """Faults of positions (n, 3) and quaternions (n, 4); rows of NaN are left out."""
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.abs(positions).max(axis=1, initial=0.0) > _MAX_M
        length = np.linalg.norm(quats, axis=1)
        short = (length <= 1e-12) | np.isinf(length)
    faults = dict.fromkeys(np.flatnonzero(far).tolist(), f"its position is more than {_MAX_M:g} m away")
    return faults | dict.fromkeys(np.flatnonzero(short).tolist(), "its quaternion has no direction")


def lost_faults(positions: FloatArray, identity: BoolArray) -> Faults:
    """Faults of poses that are exactly the identity and far from those around: as of a lost camera."""
    # those at the start may be the origin of a path that goes on after a pause, as that of SLAM
    at, others = np.flatnonzero(identity), np.flatnonzero(~identity & (np.abs(positions) <= _MAX_M).all(axis=1))
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
