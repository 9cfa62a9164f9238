"""Text files with a pose a line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .errors import TrajectoryFileError


def read_rows(path: Path, parse: Callable[[str], list[float]], width: int, expected: str) -> npt.NDArray[np.float64]:
    """Rows (n, width) of a file; blank lines and those that start with ``#`` are skipped.

    Parameters
    ----------
    path
        The file.
    parse
        Turns a line into numbers; may raise ValueError or IndexError.
    width
        Numbers a line.
    expected
        What a line should be, for people.

    Raises
    ------
    TrajectoryFileError
        If the file cannot be read, holds no pose, or a line is not `width` finite numbers; names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise TrajectoryFileError(f"{path}: cannot be read as a trajectory: {exc}") from exc
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = parse(line)
        except (ValueError, IndexError):
            row = []
        if len(row) != width or not np.isfinite(row).all():
            raise TrajectoryFileError(f"{path}, line {number}: expected {expected}, got {line[:80]!r}")
        rows.append(row)
    if not rows:
        raise TrajectoryFileError(f"{path}: holds no pose; expected lines of {expected}")
    return np.array(rows)
