"""Motions between test frames, which trainings share: they depend on frames, noise and front end alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.datasets import Sequence
from conformodal.odometry import Method, MotionRecord, measure_motions, paper_motions

from .conditions import TrainingTask


class MotionMemory:
    """Motions measured so far for the trainings of one group."""

    def __init__(self) -> None:
        self._group = ""
        self._found: dict[Any, MotionRecord] = {}

    def measured(self, task: TrainingTask, noisy: Sequence, frames: npt.NDArray[np.int64]) -> MotionRecord:
        """Motions of the test frames of a task, by the front end of its method.

        Parameters
        ----------
        task
            Those of one group have the same test frames.
        noisy
            The sequence with its noise.
        frames
            Increasing indices.
        """
        if task.group != self._group:
            self._group, self._found = task.group, {}
        if noisy.noise not in self._found:
            measure = paper_motions if task.method is Method.PAPER else measure_motions
            self._found[noisy.noise] = measure(noisy, frames)
        return self._found[noisy.noise]
