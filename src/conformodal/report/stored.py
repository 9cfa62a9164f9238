"""A run as it lies on disk, for figures that are drawn later."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.odometry import ResultsError, read_region_records, read_trajectories
from conformodal.poses import Trajectory, read_tum


@dataclass(frozen=True, eq=False)
class StoredRun:
    """Trajectories by method (the answer first), the truth, and one region record a frame."""

    trajectories: dict[str, Trajectory]
    truth: Trajectory
    records: list[dict[str, Any]]

    @classmethod
    def read(cls, folder: Path) -> StoredRun:
        """What ``conformodal run`` or ``reproduce`` wrote.

        Raises
        ------
        ResultsError, TrajectoryFileError
            If files are missing or damaged, or differ in length.
        """
        found = cls(
            read_trajectories(folder), read_tum(folder / "truth.tum"), read_region_records(folder / "regions.jsonl")
        )
        if not len(found.answer) == len(found.truth) == len(found.records):
            raise ResultsError(
                f"{folder}: trajectory, truth and regions differ in length; was a run overwritten half-way?"
            )
        return found

    @property
    def answer(self) -> Trajectory:
        """The smoothed trajectory."""
        return next(iter(self.trajectories.values()))

    @property
    def times_s(self) -> npt.NDArray[np.float64]:
        """Seconds since the first frame."""
        return np.asarray(self.answer.timestamps_s - self.answer.timestamps_s[0])

    def intervals(self, frame: int, target: str) -> npt.NDArray[np.float64]:
        """(m, 2) ends of a target's intervals; infinite for the whole line."""
        parts = [
            (-np.inf if a is None else a, np.inf if b is None else b)
            for a, b in self.records[frame]["intervals"][target]
        ]
        return np.array(parts).reshape(-1, 2)

    def position_sizes_m(self) -> npt.NDArray[np.float64]:
        """(n,) root of the summed squared lengths of the position's sets; infinite for the whole space."""
        lengths = [[np.ptp(self.intervals(i, t), axis=1).sum() for t in "xyz"] for i in range(len(self.records))]
        return np.asarray(np.linalg.norm(np.array(lengths), axis=1))
