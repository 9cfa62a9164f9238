"""How ambiguous places are: whether the calibrated region of a frame holds one known place, or several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import Trajectory
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.model import Localization

from .settings import QUALITY
from .view_coverage import ViewScale, runs_of


@dataclass(frozen=True)
class AmbiguousStretch:
    """Held-out frames whose regions hold several places that are known."""

    first: int
    last: int
    n_frames: int  # of those that were looked at
    n_places: int  # most places that one of the regions holds
    # metres: the true place of the middle frame, or the most probable one where it has no pose
    place_xyz: tuple[float, float, float]
    alike: list[tuple[int, int]]  # stretches of known frames elsewhere in these regions, by their own numbers


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Of m frames that no source of the regions has seen."""

    frames: IntArray  # (m,) their numbers
    n_places: IntArray  # (m,) places in each region; 0 where the region is unbounded in some target
    n_unknown: int  # frames that show no known place, by the model's test
    stretches: list[AmbiguousStretch]  # those with several places, in the order of time


class _KnownPlaces:
    """Known frames, grouped to places: each is near the first frame of its place."""

    def __init__(self, poses: Trajectory, scale: ViewScale) -> None:
        self._place = np.full(len(poses), -1)
        heads: list[int] = []
        while (self._place < 0).any():
            free = np.flatnonzero(self._place < 0)
            near = scale.change(poses[free], poses[np.full(len(free), free[0])]) <= QUALITY.place
            self._place[free[near]] = len(heads)
            heads.append(int(free[0]))
        at = poses[np.array(heads, dtype=np.int64)]
        n = len(heads)
        # heads of neighbouring places are up to twice as far apart as a frame from its head
        self._linked = np.array([scale.change(at, at[np.full(n, i)]) <= 2 * QUALITY.place for i in range(n)])

    def parts(self, held: BoolArray) -> IntArray:
        """Which of several separate places each known frame in a region is at: (k,) numbers, -1 outside the region."""
        there = np.unique(self._place[held])
        _, label = connected_components(coo_array(self._linked[np.ix_(there, there)]), directed=False)
        part = np.full(len(held), -1)
        part[held] = label[np.searchsorted(there, self._place[held])]
        return part


def ambiguity(
    frames: IntArray,
    recording: IntArray,
    found: Localization,
    known: Trajectory,
    truth: Trajectory | None,
    sign_reference: FloatArray,
    scale: ViewScale,
) -> Ambiguity:
    """Count the known places in the region of each of m held-out frames.

    `known` are the poses of the frames that the model knows. Without `truth`, the frame's own place is named among
    those that look alike.
    """
    regions, targets = found.regions, pose_targets(known, sign_reference)
    places = _KnownPlaces(known, scale)
    own = None if truth is None else scale.nearest(truth, known)
    n_places, elsewhere = np.zeros(len(frames), dtype=np.int64), np.zeros((len(frames), len(known)), dtype=np.bool_)
    for i in np.flatnonzero(~regions.unbounded.any(axis=1)).tolist():
        held = regions[np.full(len(targets), i)].contains(targets, joint=True)
        if own is not None:  # the frame's own place counts whether the region reaches a known frame of it or not
            held[own[i]] = True
        part = places.parts(held)
        n_places[i] = max(1, part.max(initial=-1) + 1)
        elsewhere[i] = held if own is None else held & (part != part[own[i]])
    where = most_probable(found) if truth is None else truth.positions_xyz
    stretches = []
    for run in runs_of(n_places > 1, recording):
        x, y, z = where[run[len(run) // 2]].tolist()
        alike, most = _alike(elsewhere[run].sum(axis=0)), int(n_places[run].max())
        stretches.append(AmbiguousStretch(int(frames[run[0]]), int(frames[run[-1]]), len(run), most, (x, y, z), alike))
    return Ambiguity(frames, n_places, int((found.kinds == EvidenceType.UNKNOWN).sum()), stretches)


def most_probable(found: Localization) -> FloatArray:
    """(m, 3) positions of the most probable hypotheses of each image by itself."""
    return np.array([c.positions_xyz[int(np.argmax(c.log_mass))] for c in found.candidates])


def _alike(counts: IntArray) -> list[tuple[int, int]]:
    """Stretches of known frames that lie in most of the regions, the most common first."""
    runs = sorted(runs_of(counts > 0, np.zeros_like(counts)), key=lambda run: -int(counts[run].max()))
    return [(int(run[0]), int(run[-1])) for run in runs[: QUALITY.most_alike]]
