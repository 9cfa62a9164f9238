"""What a stream's regions are worth, where true poses are known: counted frame by frame, in little memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.geometry import Trajectory, concatenate, pose_targets
from conformodal.io.streams.frames import Frame
from conformodal.localizer.regions import PoseRegions

from .config import Method
from .estimates import Estimate
from .evaluate import RegionStatistics, path_coverage_table
from .model import HINDSIGHT, ONLINE, PoseModel

_MERGED = 1000  # rows of a part: arrays of one row each take ten times as much memory
Part = TypeVar("Part", RegionStatistics, Trajectory)


def _gather(parts: list[Part], row: Part, merge: Callable[[list[Part]], Part]) -> None:
    """Append a part of one row; a thousand of them become one part."""
    parts.append(row)
    if len(parts) >= _MERGED and len(parts[-_MERGED]) == 1:
        parts[-_MERGED:] = [merge(parts[-_MERGED:])]


class StreamScores:
    """Statistics of the regions of a stream's answers; `truth` are true poses of its frames `posed`, None for all."""

    def __init__(self, model: PoseModel, truth: Trajectory | None = None, posed: IntArray | None = None) -> None:
        self.rows_with_truth: list[int] = []  # which of the answers have a true pose, counted from 0
        self._model, self._truth = model, truth
        frames = range(0 if truth is None else len(truth)) if posed is None else posed.tolist()
        self._row = {frame: row for row, frame in enumerate(frames)}
        self._true_poses: list[Trajectory] = []
        self._statistics: list[RegionStatistics] = []
        self._path_statistics: dict[str, list[RegionStatistics]] = {ONLINE: [], HINDSIGHT: []}
        self._reliable: list[bool] = []

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the answered frames that have one; None if none has."""
        return concatenate(self._true_poses) if self._true_poses else None

    @property
    def statistics(self) -> RegionStatistics:
        """Of the regions of all answered frames whose truth is known, if there are any."""
        return RegionStatistics.concatenate(self._statistics)

    def path_coverage(self, online: Trajectory) -> dict[str, Any] | None:
        """Of the regions from posteriors; None where the model has none or no truth is known.

        `online` are the poses that the stream gave, of all answers.
        """
        measured = {path: RegionStatistics.concatenate(parts) for path, parts in self._path_statistics.items() if parts}
        truth = self.truth
        if not measured or truth is None:
            return None
        given = online[np.array(self.rows_with_truth)]
        return path_coverage_table(measured, self._model, given, truth, np.array(self._reliable))

    def true_pose(self, frame: Frame) -> Trajectory | None:
        """The true pose of a frame, a trajectory of one; None where it is not known."""
        row = self._row.get(frame.index)
        return None if self._truth is None or row is None else self._truth[row : row + 1]

    def score(self, estimate: Estimate, truth: Trajectory) -> float | None:
        """The nonconformity score of a frame's true pose, the largest of those that calibrate; None without a belief.

        Positions alone have none, nor has the paper's method, which calibrates each target by itself.
        """
        if estimate.localization is None or self._model.method is Method.PAPER:
            return None
        if not np.isfinite(truth.orientations_quat_wxyz).all():
            return None
        targets = pose_targets(truth, self._model.sign_reference)
        scores = self._model.scores(estimate.localization.beliefs, targets)
        return float(self._model.calibration.columns(scores).max())

    def add(self, answer: int, estimate: Estimate, truth: Trajectory) -> None:
        """Count the answer of this number, counted from 0, whose true pose is known."""
        assert estimate.region is not None
        assert estimate.evidence is not None
        rooms = None if estimate.localization is None else estimate.localization.rooms
        sign, kind = self._model.sign_reference, np.array([estimate.evidence])
        of_frame = RegionStatistics.of(estimate.region, truth, sign, kind, rooms)
        _gather(self._statistics, of_frame, RegionStatistics.concatenate)
        _gather(self._true_poses, truth, concatenate)
        self.rows_with_truth.append(answer)
        self._reliable.append(estimate.reliable)
        self.add_path(ONLINE, estimate.path_region, truth)

    def add_path(self, path: str, region: PoseRegions | None, truth: Trajectory) -> None:
        """Count a region from posteriors, one of :data:`~conformodal.pipeline.model.PATHS`, if there is one."""
        if region is not None:
            of_frame = RegionStatistics.of(region, truth, self._model.sign_reference)
            _gather(self._path_statistics[path], of_frame, RegionStatistics.concatenate)
