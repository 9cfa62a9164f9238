"""Where a recording is sparse: views far from every known one, and neighbouring frames that are far apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import KDTree

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import PinholeCamera, Trajectory, angle_between_quats

from .settings import QUALITY


@dataclass(frozen=True, eq=False)
class ViewChange:
    """How much n views differ from others, (n,) each; infinite where there is no other view."""

    share: FloatArray  # of the view, see :class:`ViewScale`
    distance_m: FloatArray
    angle_deg: FloatArray


@dataclass(frozen=True)
class ViewScale:
    """What makes metres and angles comparable: the camera's field of view, and how deep the scene is.

    A camera that turns by its field of view sees nothing of what it saw; one that moves by d metres shifts things at
    the scene's depth as much as a turn by d / depth radians. The change of a view is the root of both squares, as a
    share of the field of view.

    Attributes
    ----------
    depth_m
        Median depth of what the camera sees.
    fov_rad
        The smaller of the two angles of view.
    """

    depth_m: float
    fov_rad: float

    @classmethod
    def of(cls, camera: PinholeCamera, depth_m: float) -> Self:
        """For a camera in a scene of this depth."""
        half = min(camera.width / camera.fx, camera.height / camera.fy) / 2
        return cls(depth_m, float(2 * np.arctan(half)))

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
    """Neighbouring frames whose views are far from every known one, or from each other."""

    first: int  # frame
    last: int
    place_xyz: tuple[float, float, float]  # where the view differs most, in metres
    change: float  # there, as the next two; see :class:`ViewChange`
    distance_m: float
    angle_deg: float


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
        size = (float(values[worst]) for values in (change.share, change.distance_m, change.angle_deg))
        return Stretch(int(frames[run[0]]), int(frames[last]), (x, y, z), *size)

    return PoseCoverage(
        away.share,
        [stretch(run, run[-1], away) for run in runs_of(sparse, recording)],
        [stretch(run, run[-1] + 1, steps) for run in runs_of(fast, recording)],
    )


def runs_of(chosen: BoolArray, recording: IntArray) -> Iterator[IntArray]:
    """Runs (m,) of chosen frames of one recording; short gaps do not end a run."""
    frames = np.flatnonzero(chosen)
    if frames.size:
        apart = (np.diff(frames) > QUALITY.bridged + 1) | (np.diff(recording[frames]) != 0)
        yield from np.split(frames, np.flatnonzero(apart) + 1)
