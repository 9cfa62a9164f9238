"""Text files with one pose per line: the tokenizer of all formats, and what is wrong with a pose."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import isfinite
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry.rotations import PoseError, rotation_faults
from conformodal.geometry.trajectory import Trajectory

# Farther away than any place, in metres: squares of larger numbers overflow.
_MOST_M = 1e9
_LENGTH_OFF = 0.01  # of a unit quaternion
_HEAD_LINES = 5
_LOST_STEPS, _LARGE = 10, 95  # from the identity to the poses around it, each as large as this percentile
_COLUMN = re.compile(r"\bq(?:uat)?(?:[a-z_.]*[_.])?([wxyz])\b", re.IGNORECASE)
# Fractions of seconds that are whole micro- or nanoseconds without the zeros before them: digits, and how many tell it.
_UNPADDED_DIGITS, _UNPADDED_LEAST = (6, 9), 30


class TrajectoryFileError(PoseError):
    """A trajectory file that cannot be read; names the file and the line."""


def number(text: str) -> float:
    """A number written in ASCII digits; ``float`` also takes ``1_0`` and digits of other scripts."""
    if not text.isascii() or "_" in text:
        raise ValueError(f"{text[:80]!r} is not a number")
    return float(text)


def whole_number(text: str) -> int:
    """As :func:`number`, of an integer below 10^20."""
    if not text.isascii() or "_" in text or len(text) > 20:
        raise ValueError(f"{text[:80]!r} is not a whole number")
    return int(text)


def tokens(line: str) -> list[str]:
    """What stands between commas, or semicolons, or blanks: one of them separates a line."""
    separator = next((mark for mark in ",;" if mark in line), None)
    return [token.strip() for token in line.strip().removesuffix(separator or "").split(separator)]


def numbers_in(line: str) -> list[float]:
    """The numbers of a line."""
    return [number(token) for token in tokens(line)]


def text_lines(path: Path) -> list[str]:
    """Lines of a text file in UTF-8, with the line ends of any system."""
    if path.exists() and not os.path.isfile(path):  # a pipe would be waited for
        raise OSError("is not a regular file")
    return path.read_text(encoding="utf-8-sig").splitlines()


def is_header(line: str) -> bool:
    """Whether a line begins as no number does."""
    return line.lstrip()[:1] not in "+-.0123456789"


def quaternion_order(path: Path) -> str:
    """The letters w, x, y, z in the order in which the head of a file names a quaternion's columns, or nothing."""
    with suppress(OSError, ValueError):
        for line in text_lines(path)[:_HEAD_LINES]:
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
    path: Path,
    parse: Callable[[str], list[float]],
    width: int,
    expected: str,
    damaged: dict[int, str] | None = None,
    *,
    by_line: bool = False,
) -> FloatArray:
    """Rows (n, width) of a file; blank lines, those that start with ``#``, and a header of words are skipped.

    Parameters
    ----------
    parse
        Turns a line into numbers; may raise ValueError or IndexError.
    width, expected
        Numbers per line, and what a line should be, for messages.
    damaged
        Collects what is wrong with a line, by its row, which then holds NaN but for its time. The file is still refused
        if most lines do not hold `width` numbers, or all are bad. None refuses the file for any bad line.
    by_line
        Whether rows are matched to frames by line, so that a blank line between rows or a header is ambiguous.
    """
    try:
        lines = text_lines(path)
    except (OSError, ValueError) as exc:
        raise TrajectoryFileError(f"{path}: cannot be read as a trajectory: {exc}") from exc
    rows: list[list[float]] = []
    bad: dict[int, str] = {}
    n_unread = blank = 0
    for at, line in enumerate(lines, start=1):
        if not line.strip():
            blank = blank or (at if rows else 0)
            continue
        if line.lstrip().startswith("#"):
            continue
        if by_line and blank:
            raise TrajectoryFileError(f"{path}, line {blank}: is blank; poses belong to frames by their lines")
        try:
            row = parse(line)
        except (ValueError, IndexError):
            row = []
        if len(row) != width or not all(map(isfinite, row)):
            if not rows and is_header(line):
                if by_line:
                    what = "begins with a word; poses belong to frames by their lines; put # before a header"
                    raise TrajectoryFileError(f"{path}, line {at}: {what}")
                continue
            bad[len(rows)] = f"{path}, line {at}: expected {expected}, got {line[:80]!r}"
            n_unread += len(row) != width
            row = [row[0] if len(row) == width and not by_line else np.nan, *[np.nan] * (width - 1)]
        rows.append(row)
    if not rows:
        raise TrajectoryFileError(f"{path}: holds no pose; expected lines of {expected}")
    if bad and (damaged is None or len(bad) == len(rows) or 2 * n_unread > len(rows)):
        raise TrajectoryFileError(next(iter(bad.values())))
    if damaged is not None:
        damaged.update(bad)
    return np.array(rows)


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


def drop_faults(rows: FloatArray, faults: dict[int, str], path: Path, damaged: dict[int, str] | None) -> None:
    """Set faulty rows to NaN and collect them in `damaged`; raise if that is None or no row is left."""
    lines = {i: f"{path}: pose {i} (counted from 0): {why}" for i, why in faults.items()}
    if damaged is not None:
        damaged.update({i: why for i, why in lines.items() if i not in damaged})
    if lines and (damaged is None or len(damaged) == len(rows)):
        raise TrajectoryFileError(lines[min(lines)])
    rows[list(lines)] = np.nan
