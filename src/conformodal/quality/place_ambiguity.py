"""How ambiguous places are: whether the calibrated region of a frame holds one place, or several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.geometry import Trajectory
from conformodal.localizer.observations import Place
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.model import Localization

from .settings import QUALITY
from .view_coverage import ViewScale, runs_of

Point = tuple[float, float, float]


@dataclass(frozen=True)
class AmbiguousStretch:
    """Held-out frames whose regions hold several places."""

    first: int
    last: int
    n_frames: int  # of those that were looked at
    n_places: int  # most places that one of the regions holds
    place_xyz: Point  # metres: the most probable place of the frame in the middle
    alike_xyz: Point  # the one after it


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Of m frames that no source of the regions has seen."""

    frames: IntArray  # (m,) their numbers
    n_places: IntArray  # (m,) places in each region; 0 where the region is unbounded in some target
    n_unknown: int  # frames that show no known place, by the model's test
    stretches: list[AmbiguousStretch]  # those with several places, in the order of time


def ambiguity(frames: IntArray, recording: IntArray, answers: Localization, scale: ViewScale) -> Ambiguity:
    """Count the places in the region of each of m held-out frames."""
    regions = answers.regions
    unbounded = np.asarray(regions.unbounded.any(axis=1))
    places = [[] if unbounded[i] else _distinct(regions.places(i), scale) for i in range(len(frames))]
    n_places = np.array([len(several) for several in places], dtype=np.int64)
    stretches = []
    for run in runs_of(n_places > 1, recording):
        first, last, middle = int(frames[run[0]]), int(frames[run[-1]]), places[run[len(run) // 2]]
        one, other = (place.position_xyz.tolist() for place in middle[:2])
        stretches.append(AmbiguousStretch(first, last, len(run), int(n_places[run].max()), tuple(one), tuple(other)))
    return Ambiguity(frames, n_places, int((answers.kinds == EvidenceType.UNKNOWN).sum()), stretches)


def _distinct(places: Sequence[Place], scale: ViewScale) -> list[Place]:
    """Of places with the most probable first, those whose views have nothing in common with a more probable one."""
    distinct: list[Place] = []
    for place in places:
        if not distinct or scale.change(_poses([place] * len(distinct)), _poses(distinct)).share.min() > QUALITY.apart:
            distinct.append(place)
    return distinct


def _poses(places: Sequence[Place]) -> Trajectory:
    positions = np.array([place.position_xyz for place in places])
    quats = np.array([place.orientation_quat_wxyz for place in places])
    return Trajectory(np.arange(float(len(places))), positions, quats)
