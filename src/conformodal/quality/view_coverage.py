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

    def change(self, one: Trajectory, other: Trajectory) -> FloatArray:
        """Share of the view that changes between n pairs of poses, (n,)."""
        metres, radians = _apart(one, other)
        return np.asarray(np.hypot(metres / self.depth_m, radians) / self.fov_rad)

    def nearest(self, views: Trajectory, known: Trajectory) -> IntArray:
        """Which of the known views, at least one, changes least into each of n views, (n,)."""
        points = self._embedded(known)
        mirrored = points * np.array([1, 1, 1, -1, -1, -1, -1])  # q and -q are one rotation
        _, rows = KDTree(np.concatenate((points, mirrored))).query(self._embedded(views))
        return np.asarray(rows, dtype=np.int64) % len(known)

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
    # there: a share of the view, see :class:`ViewScale`; infinite without a known view, as the next two
    change: float
    distance_m: float
    angle_deg: float
    nearest: int = -1  # index of the known view that is nearest there; -1 for fast motion


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
    poses: Trajectory, recording: IntArray, known: Trajectory, scale: ViewScale, frames: IntArray | None = None
) -> PoseCoverage:
    """Compare the views along the path of a camera with those of known frames.

    Poses are in order of time, with the number (n,) of each one's recording, and of its frame if that is not its row.
    A known frame covers itself.
    """
    n = len(poses)
    frames = np.arange(n) if frames is None else frames
    nearest, change, apart = np.full(n, -1), np.full(n, np.inf), (np.full(n, np.inf), np.full(n, np.inf))
    if len(known):
        nearest = scale.nearest(poses, known)
        change, apart = scale.change(poses, known[nearest]), _apart(poses, known[nearest])
    sparse = change > QUALITY.sparse
    steps, fast = scale.change(poses[:-1], poses[1:]), np.diff(recording) == 0
    # what is to be recorded anyway is not too fast as well
    fast &= (steps > QUALITY.fast) & ~(sparse[:-1] & sparse[1:])
    step_apart, no_view = _apart(poses[:-1], poses[1:]), np.full(n, -1)

    def stretch(run: IntArray, ends: IntArray, is_sparse: bool) -> Stretch:
        size, (metres, radians), view = (change, apart, nearest) if is_sparse else (steps, step_apart, no_view)
        worst = int(run[np.argmax(size[run])])
        x, y, z = poses.positions_xyz[worst].tolist()
        degrees = float(np.degrees(radians[worst]))
        return Stretch(
            int(ends[0]), int(ends[-1]), (x, y, z), float(size[worst]), float(metres[worst]), degrees, int(view[worst])
        )

    return PoseCoverage(
        change,
        [stretch(run, frames[run], True) for run in runs_of(sparse, recording)],
        [stretch(run, frames[[run[0], run[-1] + 1]], False) for run in runs_of(fast, recording)],
    )


def runs_of(chosen: BoolArray, recording: IntArray) -> Iterator[IntArray]:
    """Runs (m,) of chosen frames of one recording; short gaps do not end a run."""
    frames = np.flatnonzero(chosen)
    if frames.size:
        apart = (np.diff(frames) > QUALITY.bridged + 1) | (np.diff(recording[frames]) != 0)
        yield from np.split(frames, np.flatnonzero(apart) + 1)


def _apart(one: Trajectory, other: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Metres and radians between n pairs of poses, (n,) each."""
    metres = np.linalg.norm(one.positions_xyz - other.positions_xyz, axis=1)
    return metres, angle_between_quats(one.orientations_quat_wxyz, other.orientations_quat_wxyz)
