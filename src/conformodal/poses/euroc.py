"""EuRoC's ground truth: CSV with ``timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z`` and perhaps more columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .errors import PoseError, TrajectoryFileError
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
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise TrajectoryFileError(f"{path}: cannot be read as EuRoC ground truth: {exc}") from exc
    times, rows = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(",")[:8]
        try:
            # whole nanoseconds: as floats, today's would lose a quarter of a microsecond
            nanoseconds, row = int(fields[0]), [float(field) for field in fields[1:]]
        except ValueError:
            nanoseconds, row = 0, []
        if len(row) != 7 or not np.isfinite(row).all():
            raise TrajectoryFileError(
                f"{path}, line {number}: expected 'timestamp [ns], x, y, z, qw, qx, qy, qz', got {line[:80]!r}"
            )
        times.append(nanoseconds / 1e9)
        rows.append(row)
    if not rows:
        raise TrajectoryFileError(f"{path}: holds no pose; expected lines 'timestamp [ns], x, y, z, qw, qx, qy, qz'")
    data = np.array(rows)
    try:
        return Trajectory(np.array(times), data[:, :3], data[:, 3:])
    except PoseError as exc:
        raise TrajectoryFileError(f"{path}: {exc}") from exc
