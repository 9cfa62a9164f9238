"""Rooms of a world: recordings near each other are of one room, and each room keeps its own coverage.

Scores of frames are larger in some rooms than in others, and larger where an image is novel, so one threshold for all
holds fewer poses there and more elsewhere. Thresholds by group are Mondrian calibration (Vovk et al. 2003); the group
of a frame is a function of its image and belief, the same for frames that calibrate and new ones, and never of the true
pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from conformodal.conformal import SplitConformal
from conformodal.conformal.checks import as_alpha
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

from .mixtures import PoseMixture

# Two recordings are of one room if this share of the frames of either lies within so many scene depths of the other
_NEAR_DEPTHS, _MIN_SHARE = 0.5, 0.5


@dataclass(frozen=True, eq=False)
class Rooms:
    """Positions (m, 3) of known frames, and the room (m,) of each, counted from 0."""

    positions_xyz: FloatArray
    rooms: IntArray

    @classmethod
    def of(cls, positions_xyz: FloatArray, recording: IntArray, depth_m: float) -> Self | None:
        """From frames at positions (m, 3) of numbered recordings (m,), in scenes of this median depth.

        None if all are of one room, or the depth is not known (NaN).
        """
        if not np.isfinite(depth_m):
            return None
        names, numbers = np.unique(recording, return_inverse=True)
        paths = [positions_xyz[numbers == i] for i in range(len(names))]
        trees = [KDTree(path) for path in paths]
        near_m = _NEAR_DEPTHS * depth_m
        joined = [[_share_near(path, tree, near_m) >= _MIN_SHARE for tree in trees] for path in paths]
        n_rooms, room = connected_components(np.array(joined), directed=True, connection="weak")
        return cls(positions_xyz, room[numbers].astype(np.int64)) if n_rooms > 1 else None

    @cached_property
    def _known(self) -> KDTree:
        return KDTree(self.positions_xyz)

    def rooms_of(self, beliefs: Sequence[PoseMixture]) -> IntArray:
        """The room (n,) of the most probable hypothesis of each of n beliefs: that of the nearest known frame."""
        best = [one.positions_xyz[np.argmax(one.log_weights)] for one in beliefs]
        return self.rooms[self._known.query(np.reshape(best, (-1, 3)))[1]]


def _share_near(path: FloatArray, other: KDTree, near_m: float) -> float:
    """The share of a path's positions (m, 3) that are near another path."""
    return float(np.isfinite(other.query(path, distance_upper_bound=near_m)[0]).mean())


def part_of(rule: SplitConformal, chosen: BoolArray) -> SplitConformal:
    """A rule calibrated on some of its frames (n,) alone; each keeps its weight in its stretch.

    So the guarantees of all parts add up to that of a new stretch.
    """
    part = SplitConformal(rule.bins, rule.alpha, rule.score, rule.joint, rule.empty)
    if rule.joint == "max":
        loc, scale = rule.scales()
        part.set_scale(scale, loc)
    if rule.units_ is None:
        return part.calibrate_scores(rule.scores_[chosen])
    sizes = rule.unit_sizes_
    if sizes is None:
        _, group, counts = np.unique(rule.units_, return_inverse=True, return_counts=True)
        sizes = counts[group]
    return part.calibrate_scores(rule.scores_[chosen], rule.units_[chosen], sizes[chosen])


def thresholds_by_group(rule: SplitConformal, groups: IntArray) -> dict[int, RealArray]:
    """Thresholds (d,) of each group, such as a room, from the calibration frames of a rule and their groups (n,).

    Groups whose frames weigh less than a finite threshold needs are calibrated together: each has at least the
    threshold of all of them, and at least its own quantile. If all of them still weigh too little, they have at least
    the threshold of all groups, and no guarantee of their own.
    """
    parts = {group: part_of(rule, groups == group) for group in np.unique(groups).tolist()}
    small = [group for group, own in parts.items() if not weighs_enough(own)]
    limits = {group: own.thresholds_ for group, own in parts.items()}
    if small:
        together = part_of(rule, np.isin(groups, small))
        least = together.thresholds_
        if not weighs_enough(together):  # the infinite scores of one group are not those of the others
            quantile = _quantile(together)
            least = np.maximum(np.where(np.isfinite(quantile), quantile, -np.inf), rule.thresholds_)
        limits |= {group: np.maximum(_quantile(parts[group]), least) for group in small}
    return limits


@dataclass(frozen=True, eq=False)
class NoveltyLimits:
    """Thresholds of frames whose image is novel, and of the others, in each room."""

    of_all: RealArray  # (d,) of all frames
    by_novelty: dict[bool, RealArray]
    by_room: dict[tuple[bool, int], RealArray]  # where a kind weighs enough for thresholds of its own

    @classmethod
    def of(cls, rule: SplitConformal, novel: BoolArray, rooms: IntArray) -> Self:
        """From the calibration frames of a rule, (n,) whether these are novel, and their rooms (n,)."""
        of_kinds = thresholds_by_group(rule, novel.astype(np.int64))
        by_novelty = {bool(kind): limit for kind, limit in of_kinds.items()}
        by_room: dict[tuple[bool, int], RealArray] = {}
        for kind in by_novelty:
            part = part_of(rule, novel == kind)
            if weighs_enough(part):
                limits = thresholds_by_group(part, rooms[novel == kind])
                by_room |= {(kind, room): limit for room, limit in limits.items()}
        return cls(rule.thresholds_, by_novelty, by_room)

    def __call__(self, novel: BoolArray, rooms: IntArray) -> RealArray:
        """(m, d) of new frames: of their room, or of all rooms or frames where none of their own calibrate."""
        limits = [
            self.by_room.get((kind, room), self.by_novelty.get(kind, self.of_all))
            for kind, room in zip(novel.tolist(), rooms.tolist(), strict=True)
        ]
        return np.reshape(limits, (-1, self.of_all.size))


def weighs_enough(rule: SplitConformal) -> bool:
    """Whether calibration frames weigh as much as a finite threshold needs."""
    return bool(rule.weight >= 1 / rule.alpha_per_target - 1)


def _quantile(rule: SplitConformal) -> RealArray:
    """The quantile (d,) of calibration scores, without the margin for a new frame; minus infinity if there is none."""
    rate, weight = rule.alpha_per_target, rule.weight
    # at this rate, the rank among `weight + 1` is that of alpha among `weight`
    share = (1 + weight * rate) / (weight + 1) * as_alpha(rule.alpha) / rate
    if share >= 1:
        return np.full(rule.bins.n_targets, -np.inf)
    return rule.at(share).thresholds_
