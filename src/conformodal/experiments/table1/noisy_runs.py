"""Runs over the test part with pixel noise; relative motions are measured once for all trainings that share them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.datasets import PixelNoise, Sequence
from conformodal.odometry import (
    MotionRecord,
    OdometryRun,
    PoseModel,
    odometry_of,
    write_run,
)
from conformodal.poses import Trajectory
from conformodal.vision import FeatureCache, extract_features

from .conditions import TrainingTask, run_name


@dataclass(frozen=True, eq=False)
class NoisyRun:
    """A model's answers to n test frames at one noise.

    Attributes
    ----------
    sigma
        Pixel noise.
    run
        The answers; trajectories of other methods are added.
    motions
        Behind them.
    features
        (n, F) of the disturbed images.
    truth, recording
        Of the answered frames: poses, and (n,) the recording that each belongs to.
    names
        Of their image files.
    """

    sigma: float
    run: OdometryRun
    motions: MotionRecord
    features: npt.NDArray[np.float32]
    truth: Trajectory
    recording: npt.NDArray[np.int64]
    names: list[str]


class NoisyRuns:
    """Makes and keeps runs on one data set.

    Motions depend on frames, noise and front end alone, so that all trainings of a task's group share them.

    Parameters
    ----------
    sequence
        With poses.
    cache
        Of features.
    folder
        For the whole runs of seed 0, each in the layout that ``conformodal run`` writes; None keeps none.
    """

    def __init__(self, sequence: Sequence, cache: FeatureCache, folder: Path | None) -> None:
        self.sequence, self.cache, self.folder = sequence, cache, folder
        self._group = ""
        self._motions: dict[float, MotionRecord] = {}

    def of(self, task: TrainingTask, model: PoseModel, sigma: float) -> NoisyRun:
        """The run of a task's model at a noise."""
        noisy = replace(self.sequence, noise=PixelNoise(sigma, task.seed) if sigma else None)
        odometry, test = odometry_of(model), model.split.test
        if task.group != self._group:
            self._group, self._motions = task.group, {}
        if sigma not in self._motions:
            self._motions[sigma] = odometry.measure_motions(noisy, test)
        motions = self._motions[sigma]
        run = odometry.process(noisy, test, cache=self.cache, motions=motions)
        paths = [self.sequence.image_paths[i] for i in run.frames]
        return NoisyRun(
            sigma,
            run,
            motions,
            extract_features(paths, model.backbone, self.cache, noise=noisy.noise),
            self.sequence.require_truth()[run.frames],
            self.sequence.recording[run.frames],
            [path.name for path in paths],
        )

    def keep(self, task: TrainingTask, found: NoisyRun) -> Path | None:
        """Write a run of seed 0; returns its folder, None where it is not kept."""
        if self.folder is None or task.seed != 0:
            return None
        place = self.folder / run_name(task.key, found.sigma)
        write_run(place, found.run, found.names, found.truth)
        return place
