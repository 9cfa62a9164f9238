"""Which columns of a trajectory are what, by names in its head or by lengths; and commas that are decimal marks."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.io.errors import DatasetError
from conformodal.io.reading import number, tokens

_LENGTH_OFF = 0.01  # of a unit quaternion
_ORDER = re.compile(r"\bq(?:uat)?(?:[a-z_.]*[_.])?([wxyz])\b", re.IGNORECASE)
_UNITS = re.compile(r"\[[^\]]*\]|\([^)]*\)")
_DECIMAL_COMMAS = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
_PARTS = re.compile(r"[._/:\s]+")
_AXIS = re.compile(r"(q|quat|quaternion|t|p|pos|position|trans|loc)?([wxyz])")
_QUATERNION = {"q", "quat", "quaternion", "orientation", "rotation", "rot"}
_CLEAR = {"p", "t", "pos", "position", "trans", "translation", *_QUATERNION}
# what else than a position has x, y and z
_OTHERS = {"v", "vel", "velocity", "twist", "linear", "angular", "omega", "acc", "acceleration", "bias", "gyro", "imu"}
_OTHERS |= {"euler", "rpy", "cov", "covariance", "scale", "mag", "std", "sigma", "var", "variance", "err", "error"}
_TIMES = {"timestamp", "timestamps", "time", "times", "stamp", "t", "ts", "utc", "timestamp_s", "time_s"}
_TIMES |= {"timestamp_ns", "time_ns", "timestamp_us", "time_us", "timestamp_ms", "time_ms", "stamp_s", "stamp_ns"}
_METRES = {"m", "meter", "meters", "metre", "metres"}
_SECONDS, _NANOSECONDS = {"sec", "secs", "seconds"}, {"nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"}
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")


class Columns(NamedTuple):
    """Where the numbers of a pose stand in a line."""

    names: tuple[str, ...]  # of all columns
    time: int
    nanoseconds: int | None  # that are added to the time
    pose: tuple[int, ...]  # x y z qx qy qz qw

    @property
    def order(self) -> str:
        """The letters of the quaternion as they follow each other."""
        return "".join(letter for _, letter in sorted(zip(self.pose[3:], "xyzw", strict=True)))

    def parse(self, line: str) -> list[float]:
        """Time, position and quaternion ``xyzw`` of a line."""
        values = tokens(line)
        if len(values) != len(self.names):
            raise ValueError(f"expected {len(self.names)} numbers, got {len(values)}")
        # whole nanoseconds lose nothing before their division
        time = number(values[self.time])
        time += 0.0 if self.nanoseconds is None else number(values[self.nanoseconds]) / 1e9
        return [time, *(number(values[k]) for k in self.pose)]


def named_columns(path: Path, heads: list[str], n_columns: int) -> Columns | None:
    """The columns by the names in one of the head lines, if it names a whole pose; refuses a name that is there twice.

    Parameters
    ----------
    path
        Of the file, for messages.
    heads
        Lines before the first pose.
    n_columns
        Numbers of a line; further names are words that follow.
    """
    for line in reversed(heads):
        names = [name.strip("\"' ") for name in tokens(_UNITS.sub("", line).lstrip("#% \t").lower())][:n_columns]
        roles = [_role(name) for name in names]
        if len(names) != n_columns or not {*POSE} <= {*roles} or not {"time", "sec"} & {*roles}:
            continue
        pose = tuple(_only(path, role, names, roles) for role in POSE)
        stamps = [k for k, role in enumerate(roles) if role == "time"]
        if "sec" in roles and ("nsec" in roles or not stamps):
            return Columns(tuple(names), roles.index("sec"), roles.index("nsec") if "nsec" in roles else None, pose)
        time = next((k for k in stamps if "stamp" in names[k]), stamps[0])
        return Columns(tuple(names), time, None, pose)
    return None


def _only(path: Path, role: str, names: list[str], roles: list[str]) -> int:
    """The column of a role; of several, the one that is named most clearly."""
    at = [k for k, one in enumerate(roles) if one == role]
    clearness = [2 * bool({*_words(names[k])} & _CLEAR) + (names[k] == role) for k in at]
    best = [k for k, clear in zip(at, clearness, strict=True) if clear == max(clearness)]
    if len(best) > 1:
        twice = " and ".join(names[k] for k in best)
        raise DatasetError(f"{path}: its head names {role} twice, as {twice}; leave one column, or rename the other")
    return best[0]


def _words(name: str) -> list[str]:
    """The parts of a name, without a unit of lengths at its end."""
    parts = [part for part in _PARTS.split(name) if part]
    return (parts[:-1] if len(parts) > 1 and parts[-1] in _METRES else parts) or [""]


def _role(name: str) -> str:
    """What a column is, by its name in lower case; nothing for other ones."""
    *before, last = _words(name)
    if name in _TIMES or last in _TIMES - {"t"} or (last in {"s", "ns"} and {*before} & _TIMES):
        return "time"
    if last in _SECONDS or last in _NANOSECONDS:
        return "sec" if last in _SECONDS else "nsec"
    axis = _AXIS.fullmatch(last)
    if axis is None or {*before} & _OTHERS:
        return ""
    kind, letter = axis[1] or "", axis[2]
    if kind in _QUATERNION or {*before} & _QUATERNION:
        return f"q{letter}"
    return "" if letter == "w" else letter


def has_decimal_commas(line: str) -> bool:
    """Whether a line has numbers with a comma for a decimal mark, between blanks or semicolons."""
    values = line.strip().removesuffix(";").split(";") if ";" in line else line.split()
    return len(values) > 1 and "," in line and all(_DECIMAL_COMMAS.fullmatch(value.strip()) for value in values)


def with_decimal_points(line: str) -> str:
    """The line with points for decimal commas."""
    return line.replace(",", ".")


def quaternion_order(heads: list[str]) -> str:
    """The letters w, x, y, z in the order in which a head names a quaternion's columns, or nothing."""
    for line in heads:
        letters = "".join(_ORDER.findall(line)).lower()
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
