"""Statistics of regions: a few numbers a frame, so that long streams need not keep the regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows
from conformodal.geometry import Trajectory
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.targets import pose_targets


@dataclass(frozen=True, eq=False)
class RegionStatistics(Rows):
    """Statistics of the regions of n frames, target by target, (n, 7) each."""

    inside: BoolArray  # whether the set holds the truth
    length: FloatArray  # of the set, in the target's unit; infinite for the whole line
    n_intervals: IntArray  # that the set falls into
    unbounded: BoolArray  # whether it is the whole line
    # (n,) what each region rests on, see :class:`~conformodal.localizer.region_rules.EvidenceType`
    kinds: IntArray
    held: BoolArray  # (n,) whether the region holds the whole pose
    n_places: IntArray  # (n,) cuboids that it consists of

    @property
    def bounded(self) -> BoolArray:
        """(n,) whether the set of every target is bounded."""
        return np.asarray(~self.unbounded.any(axis=1))

    def __len__(self) -> int:
        return len(self.inside)

    @classmethod
    def of(
        cls, regions: PoseRegions, truth: Trajectory, sign_reference: FloatArray, kinds: IntArray | None = None
    ) -> RegionStatistics:
        """Statistics of the regions of frames whose poses are known; `kinds` says what each rests on."""
        kinds = np.full(len(regions), EvidenceType.GLOBAL, dtype=np.int64) if kinds is None else kinds
        targets = pose_targets(truth, sign_reference)
        inside, held = regions.contains(targets), regions.contains(targets, joint=True)
        return cls(inside, regions.length, regions.n_intervals, regions.unbounded, kinds, held, regions.n_places)
