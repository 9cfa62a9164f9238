"""EuRoC's ground truth: CSV with ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z`` and perhaps more columns."""

from __future__ import annotations

from pathlib import Path

from .errors import PoseError, TrajectoryFileError
from .text import read_rows
from .trajectory import Trajectory

_HEADER = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; timestamps are rounded to nanoseconds."""
    lines = [_HEADER]
    rows = zip(trajectory.timestamps_s, trajectory.positions_xyz, trajectory.orientations_quat_wxyz, strict=True)
    for time_s, p, q in rows:
        numbers = ",".join(f"{v:.9f}" for v in (*p, *q))
        lines.append(f"{round(float(time_s) * 1e9)},{numbers}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_euroc(path: Path) -> Trajectory:
    """Read a trajectory; columns after the eighth (velocity, biases) are left out.

    The poses are those of the body that the file is about, not of a camera on it.

    Raises
    ------
    TrajectoryFileError
        If the file is missing, holds no pose, or a line does not start with eight finite numbers.
    """
    data = read_rows(path, _parse, 8, "'timestamp [ns], x, y, z, qw, qx, qy, qz'")
    try:
        return Trajectory(data[:, 0], data[:, 1:4], data[:, 4:])
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc


def _parse(line: str) -> list[float]:
    fields = line.split(",")[:8]
    return [int(fields[0]) / 1e9, *(float(field) for field in fields[1:])]
