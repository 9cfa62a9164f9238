"""Where a recording is sparse, fast or ambiguous: its views against known ones, each other, and its regions' places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import KDTree

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import PinholeCamera, Trajectory, angle_between_quats
from conformodal.localizer.observations import Place
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.model import Localization

Point = tuple[float, float, float]
_USUAL_DEPTH_M = 2.0  # of a room


@dataclass(frozen=True)
class QualitySettings:
    """What counts as sparse, fast and ambiguous. Shares are of the field of view, see :class:`ViewScale`."""

    # a view is sparsely covered where the nearest known one differs by more. Chosen on seeds 0 to 2 of redkitchen
    # ``blocks``: of the limits tried, it tells errors over 0.1 m from others best
    sparse: float = 0.1
    # neighbouring frames that differ by more are far apart: corners leave the picture between them, and images blur.
    # Relative rotations were measured to half a degree with frames that differ by 0.12
    # (benchmarks/results/relative_motion.md, every tenth frame of redkitchen), and not beyond
    fast: float = 0.15
    bridged: int = 5  # largest number of other frames between two stretches that count as one
    apart: float = 1.0  # places of a region whose views differ by more show nothing in common: they are several
    most_looked: int = 400  # held-out frames that are localized to see how ambiguous they are, evenly spread
    most_after_training: int = 100  # the same at the end of training, which should not take much longer for it
    most_advice: int = 3
    most_share: float = 0.1  # of sparsely covered or of ambiguous frames in a recording that is good enough


QUALITY = QualitySettings()


@dataclass(frozen=True, eq=False)
class ViewChange:
    """How much n views differ from others, (n,) each; infinite where there is no other view."""

    share: FloatArray  # of the view, see :class:`ViewScale`
    distance_m: FloatArray
    angle_deg: FloatArray

    def at(self, i: int) -> tuple[float, float, float]:
        """The numbers of one view."""
        return float(self.share[i]), float(self.distance_m[i]), float(self.angle_deg[i])


@dataclass(frozen=True)
class ViewScale:
    """What makes metres and angles comparable: the camera's field of view, and how deep the scene is.

    A camera that turns by its field of view sees nothing of what it saw; one that moves by d metres shifts things at
    the scene's depth as much as a turn by d / depth radians. The change of a view is the root of both squares, as a
    share of the field of view.
    """

    depth_m: float  # median depth of what the camera sees
    fov_rad: float  # the smaller of the two angles of view

    @classmethod
    def of(cls, camera: PinholeCamera, depth_m: float) -> Self:
        """For a camera in a scene of this depth; where it is NaN, of the depth of a usual room."""
        half = min(camera.width / camera.fx, camera.height / camera.fy) / 2
        return cls(depth_m if np.isfinite(depth_m) else _USUAL_DEPTH_M, float(2 * np.arctan(half)))

    def change(self, one: Trajectory, other: Trajectory) -> ViewChange:
        """The change between n pairs of poses."""
        metres = np.linalg.norm(one.positions_xyz - other.positions_xyz, axis=1)
        radians = angle_between_quats(one.orientations_quat_wxyz, other.orientations_quat_wxyz)
        return ViewChange(np.hypot(metres / self.depth_m, radians) / self.fov_rad, metres, np.degrees(radians))

    def change_from_nearest(self, views: Trajectory, known_views: Trajectory) -> ViewChange:
        """The change of n views from the known one that differs least."""
        if not len(known_views):
            return ViewChange(*np.full((3, len(views)), np.inf))
        points = self._embedded(known_views)
        mirrored = points * np.array([1, 1, 1, -1, -1, -1, -1])  # q and -q are one rotation
        _, rows = KDTree(np.concatenate((points, mirrored))).query(self._embedded(views))
        return self.change(views, known_views[np.asarray(rows, dtype=np.int64) % len(known_views)])

    def _embedded(self, poses: Trajectory) -> FloatArray:
        """Points (n, 7) whose distances are changes of view: a quaternion moves by half of a small angle."""
        quats = 2 * poses.orientations_quat_wxyz
        return np.column_stack((poses.positions_xyz / self.depth_m, quats)) / self.fov_rad


@dataclass(frozen=True)
class Stretch:
    """Neighbouring frames whose views are far from every known one, far from each other, or those of several places."""

    first: int  # frame
    last: int
    place_xyz: Point  # metres: where the view differs most; of ambiguous frames, the most probable place in the middle
    change: float  # there, as the next two, see :class:`ViewChange`; between the two places of ambiguous frames
    distance_m: float
    angle_deg: float
    alike_xyz: Point | None = None  # the other place of ambiguous frames


@dataclass(frozen=True, eq=False)
class PoseCoverage:
    """What poses alone tell of n frames; stretches are in the order of time."""

    change: FloatArray  # (n,) how much each frame's view differs from the nearest known one
    sparse: list[Stretch]  # far from every known view
    fast: list[Stretch]  # neighbours far apart

    @property
    def sparse_frames(self) -> BoolArray:
        """(n,) whether no known view is near."""
        return self.change > QUALITY.sparse


def pose_coverage(
    poses: Trajectory, recording: IntArray, known_views: Trajectory, scale: ViewScale, frames: IntArray | None = None
) -> PoseCoverage:
    """Compare the views along the path of a camera with those of known frames.

    Poses are in order of time, with the number (n,) of each one's recording, and of its frame if that is not its row.
    A known frame covers itself.
    """
    frames = np.arange(len(poses)) if frames is None else frames
    away, steps = scale.change_from_nearest(poses, known_views), scale.change(poses[:-1], poses[1:])
    sparse = away.share > QUALITY.sparse
    # what is to be recorded anyway is not too fast as well
    fast = (steps.share > QUALITY.fast) & (np.diff(recording) == 0) & ~(sparse[:-1] & sparse[1:])

    def stretch(run: IntArray, last: int, change: ViewChange) -> Stretch:
        worst = int(run[np.argmax(change.share[run])])
        x, y, z = poses.positions_xyz[worst].tolist()
        return Stretch(int(frames[run[0]]), int(frames[last]), (x, y, z), *change.at(worst))

    return PoseCoverage(
        away.share,
        [stretch(run, run[-1], away) for run in _runs_of(sparse, recording)],
        [stretch(run, run[-1] + 1, steps) for run in _runs_of(fast, recording)],
    )


@dataclass(frozen=True, eq=False)
class Ambiguity:
    """Of m frames that no source of the regions has seen."""

    frames: IntArray  # (m,) their numbers
    n_places: IntArray  # (m,) places in each region; 0 where the region is unbounded in some target
    n_unknown: int  # frames that show no known place, by the model's test
    stretches: list[Stretch]  # those with several places, in the order of time
    n_bounded: int  # regions that are bounded in every target
    median_length: tuple[float, ...]  # of these, in x, y and z; NaN without one


def ambiguity(frames: IntArray, recording: IntArray, answers: Localization, scale: ViewScale) -> Ambiguity:
    """Count the places in the region of each of m held-out frames."""
    unbounded = np.asarray(answers.regions.unbounded.any(axis=1))
    places = [[] if unbounded[i] else _distinct(answers.regions.places(i), scale) for i in range(len(frames))]
    n_places = np.array([len(several) for several in places], dtype=np.int64)
    stretches = []
    for run in _runs_of(n_places > 1, recording):
        first, last, middle = int(frames[run[0]]), int(frames[run[-1]]), _poses(places[run[len(run) // 2]][:2])
        (x, y, z), (u, v, w) = middle.positions_xyz.tolist()
        change = scale.change(middle[:1], middle[1:]).at(0)
        stretches.append(Stretch(first, last, (x, y, z), *change, alike_xyz=(u, v, w)))
    lengths = answers.regions.length[~unbounded, :3]
    median = tuple(np.median(lengths, axis=0).tolist()) if len(lengths) else (np.nan,) * 3
    n_unknown = int((answers.kinds == EvidenceType.UNKNOWN).sum())
    return Ambiguity(frames, n_places, n_unknown, stretches, len(lengths), median)


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


def _runs_of(chosen: BoolArray, recording: IntArray) -> Iterator[IntArray]:
    """Runs (m,) of chosen frames of one recording; short gaps do not end a run."""
    frames = np.flatnonzero(chosen)
    if frames.size:
        apart = (np.diff(frames) > QUALITY.bridged + 1) | (np.diff(recording[frames]) != 0)
        yield from np.split(frames, np.flatnonzero(apart) + 1)
