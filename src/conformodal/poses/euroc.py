"""EuRoC's ground truth: CSV with ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z`` and perhaps more columns."""

from __future__ import annotations

from pathlib import Path

from conformodal.core.arrays import FloatArray

from .text import drop_faults, number, pose_faults, read_rows, trajectory_of, whole_number
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
    return trajectory_of(path, euroc_table(path))


def euroc_table(path: Path, damaged: dict[int, str] | None = None) -> FloatArray:
    """As :func:`~conformodal.poses.tum.tum_table`, of EuRoC's format."""
    rows = read_rows(path, _parse, 8, "'timestamp [ns], x, y, z, qw, qx, qy, qz'", damaged)
    drop_faults(rows, pose_faults(rows[:, 1:4], rows[:, 4:]), path, damaged)
    return rows


def _parse(line: str) -> list[float]:
    fields = line.split(",")[:8]
    return [whole_number(fields[0].strip()) / 1e9, *(number(field) for field in fields[1:])]
