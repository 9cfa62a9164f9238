"""The tasks of table 1: one training of a system and of every baseline, and their errors at every noise."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from conformodal.datasets import Sequence
from conformodal.odometry import Method, prepare_training_data, provenance, write_metrics
from conformodal.vision import FeatureCache

from .conditions import TrainingTask, config_of
from .noisy_runs import NoisyRuns
from .our_results import our_results
from .paper_results import paper_results
from .trained import Trained, train_all


class Table1Worker:
    """Works out training tasks on one data set.

    Parameters
    ----------
    sequence
        With poses.
    cache
        Of features.
    runs
        Folder for the whole runs of seed 0, each in the layout that ``conformodal run`` writes: what figures are
        drawn from. None keeps none.
    """

    def __init__(self, sequence: Sequence, cache: FeatureCache, runs: Path | None = None) -> None:
        self.sequence = sequence
        self.cache = cache
        self._runs = NoisyRuns(sequence, cache, runs)

    def __call__(self, task: TrainingTask) -> dict[str, Any]:
        """Errors, coverage and cost, by noise; JSON."""
        data = prepare_training_data(self.sequence, config_of(task), self.cache)
        trained = train_all(task, data)
        return {
            "frames": {name: len(data.split.part(name)) for name in ("train", "calibration", "test")},
            "classical": asdict(trained.classical.training),
            "cost": trained.cost,
            "noise": {f"{sigma:g}": self._tested(task, trained, sigma) for sigma in task.sigmas},
        }

    def _tested(self, task: TrainingTask, trained: Trained, sigma: float) -> dict[str, Any]:
        found = self._runs.of(task, trained.model, sigma)
        if task.method is not Method.PAPER:
            results = our_results(trained, found)
            self._runs.keep(task, found)
            return results
        results = paper_results(trained, found)
        place = self._runs.keep(task, found)
        if place is not None:  # says whose answer it is
            configuration = trained.model.settings
            write_metrics(place, {"command": "run", "provenance": provenance(), "configuration": configuration})
        return results
