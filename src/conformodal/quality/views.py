"""How much of the picture changes from one view to another, and which known view is nearest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.poses import PinholeCamera, Trajectory, angle_between_quats

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
        moved = np.linalg.norm(one.positions_xyz - other.positions_xyz, axis=1) / self.depth_m
        turned = angle_between_quats(one.orientations_quat_wxyz, other.orientations_quat_wxyz)
        return np.asarray(np.hypot(moved, turned) / self.fov_rad)

    def embed(self, poses: Trajectory) -> FloatArray:
        """Points (n, 7) whose distances are changes of view: a quaternion moves by half of a small angle."""
        quats = 2 * poses.orientations_quat_wxyz
        return np.column_stack((poses.positions_xyz / self.depth_m, quats)) / self.fov_rad


@dataclass(frozen=True, eq=False)
class Nearest:
    """Of n views: the known view that is nearest to each (-1 where there is none), and how much differs."""

    index: IntArray
    change: FloatArray


class KnownViews:
    """Poses of known frames, to be searched."""

    def __init__(self, poses: Trajectory, scale: ViewScale) -> None:
        self.poses, self.scale = poses, scale
        points = scale.embed(poses)
        mirrored = points * np.array([1, 1, 1, -1, -1, -1, -1])  # q and -q are one rotation
        self._tree = KDTree(np.concatenate((points, mirrored))) if len(poses) else None

    def nearest(self, views: Trajectory) -> Nearest:
        """The nearest known view of each of n."""
        n, k = len(views), len(self.poses)
        if self._tree is None:
            return Nearest(np.full(n, -1), np.full(n, np.inf))
        _, found = self._tree.query(self.scale.embed(views))
        index = np.asarray(found, dtype=np.int64) % k
        return Nearest(index, self.scale.change(views, self.poses[index]))


@dataclass(frozen=True, eq=False)
class Stations:
    """Views along the way of a camera, at its frames and between them.

    Attributes
    ----------
    at
        (m,) frames; fractions are between two neighbours.
    views
        m poses.
    """

    at: FloatArray
    views: Trajectory


def stations(poses: Trajectory, recording: IntArray, scale: ViewScale) -> Stations:
    """The frames of recordings and, where neighbours are far apart, points of the straight way between them.

    Poses are in order of time, with the number (n,) of each one's recording.
    """
    n = len(poses)
    parts = np.ones(n, dtype=np.int64)
    linked = np.flatnonzero(np.diff(recording) == 0)
    if linked.size:
        steps = scale.change(poses[linked], poses[linked + 1])
        halves = np.ceil(steps / QUALITY.spacing / 2)  # an even number has a station in the middle
        parts[linked] = np.where(steps > QUALITY.spacing, np.minimum(2 * halves, QUALITY.most_stations), 1)
    start = np.repeat(np.arange(n), parts)
    share = np.concatenate([np.arange(k) / k for k in parts.tolist()]) if n else np.empty(0)
    end = np.minimum(start + 1, n - 1)
    places, times = poses.positions_xyz, poses.timestamps_s
    turns = Rotation.from_quat(poses.orientations_quat_wxyz, scalar_first=True)
    turned = turns[start] * Rotation.from_rotvec(share[:, None] * (turns[start].inv() * turns[end]).as_rotvec())
    views = Trajectory(
        times[start] + share * (times[end] - times[start]),
        places[start] + share[:, None] * (places[end] - places[start]),
        turned.as_quat(scalar_first=True),
    )
    return Stations(start + share, views)
