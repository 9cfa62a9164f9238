"""Results written as they come, so that a run that is stopped has kept all before."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np
import numpy.typing as npt

from conformodal.poses import RelativeMotion, Trajectory, tum_lines

from .answers import METHODS
from .records import REGIONS, TRAJECTORY, TRUTH, region_record
from .region_rules import Evidence


class ResultsWriter:
    """Writes ``regions.jsonl``, ``trajectory.tum`` (the answer), ``methods/NAME.tum`` and ``truth.tum``.

    Parameters
    ----------
    folder
        Created if missing; results of an earlier run in it are replaced.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "methods").mkdir(parents=True, exist_ok=True)
        for old in [*(folder / "methods").glob("*.tum"), folder / TRAJECTORY, folder / TRUTH]:
            old.unlink(missing_ok=True)
        self._open: dict[str, TextIO] = {}
        self._lines(REGIONS, [])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def region(
        self,
        name: str,
        timestamp_s: float,
        motion: RelativeMotion | None,
        intervals: Sequence[npt.NDArray[np.float64]],
        known_p: float = 1.0,
        kind: Evidence = Evidence.SOFTMAX,
    ) -> dict[str, Any]:
        """Write the region of the next frame; returns its record."""
        record = region_record(name, timestamp_s, motion, intervals, known_p, kind)
        self._lines(REGIONS, [json.dumps(record)])
        return record

    def poses(self, method: str, trajectory: Trajectory) -> None:
        """Write the next poses of a method."""
        self._lines(TRAJECTORY if method == METHODS[0] else f"methods/{method}.tum", tum_lines(trajectory))

    def truth(self, trajectory: Trajectory) -> None:
        """Write the next true poses."""
        self._lines(TRUTH, tum_lines(trajectory))

    def close(self) -> None:
        """Everything is on disk afterwards."""
        for file in self._open.values():
            file.close()
        self._open.clear()

    def _lines(self, name: str, lines: Sequence[str]) -> None:
        if name not in self._open:
            # a line at a time reaches the disk, so that others can follow a run
            self._open[name] = (self.folder / name).open("w", encoding="utf-8", buffering=1)
            if name.endswith(".tum"):
                self._open[name].write("# timestamp tx ty tz qx qy qz qw  (seconds, metres, camera to world)\n")
        self._open[name].writelines(f"{line}\n" for line in lines)
