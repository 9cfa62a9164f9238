"""Poses of keyframes and focal length of a map, adjusted near the given ones.

Given poses have clock offsets, warps and noise of their own, which blur a map that believes them. Priors hold the
adjusted poses near the given ones, moved by the camera's mount; the standard deviations are learnt from the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

from .adjustment import POSITIONS, Adjustment, Bundle, Observations, PosePriors
from .camera_fit import Mounted
from .robust import MAD_OF_NORMAL
from .rotations import rigid_motions
from .triangulation import Points, Rays


@dataclass(frozen=True)
class _MapPosesSettings:
    """Adjustment of a map's poses."""

    rounds: int = 2  # of triangulation and adjustment; sigmas and mount are learnt after each
    iterations: int = 8
    enough: float = 3e-3  # share of the cost below which an iteration ends it
    tracks: int = 80  # of each frame, the longest first
    least_views: int = 3
    least_per_frame: float = 20.0  # observations, on average: with fewer, poses stay as given
    # standard deviations of the given poses at first, and how far they may fall
    sigma_rad: float = float(np.radians(1.0))
    sigma_depths: float = 0.01
    least_sigma: float = 0.05
    sigma_focal: float = 0.02  # of the logarithm of the focal length


MAP_POSES = _MapPosesSettings()


class TriangulatedRays(NamedTuple):
    """Rays with the points of their corners."""

    rays: Rays
    points: Points


class Tracks(NamedTuple):
    """Points, each seen by several frames at disjoint corners."""

    points: FloatArray  # (p, 3)
    point: IntArray  # (m,) 0 to p - 1, increasing: the point of each observation
    frame: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1


@dataclass(frozen=True, eq=False)
class MapPoses:
    """A camera, its poses ``T_world_cam`` (n, 4, 4), and the learnt sigmas (6,) of the given ones.

    Sigmas are radians in the camera's frame, and metres.
    """

    mounted: Mounted
    poses_cam: FloatArray
    sigmas: FloatArray

    def adjusted(self, poses_se3: FloatArray, tracks: Tracks) -> MapPoses:
        """Poses and camera after bundle adjustment, and mount and sigmas learnt from how far poses moved."""
        camera = self.mounted.camera
        priors = PosePriors(poses_se3 @ self.mounted.T_pose_cam, self.sigmas)
        order = np.argsort(tracks.frame, kind="stable")
        adjustment = Adjustment(
            Observations(tracks.frame[order], tracks.point[order], tracks.plane[order]),
            sigma=2 / (camera.fx + camera.fy),
            cauchy=1.0,
            unknown=POSITIONS,
            iterations=MAP_POSES.iterations,
            enough=MAP_POSES.enough,
            priors=priors,
            focal_sigma=MAP_POSES.sigma_focal,
        )
        points = np.column_stack((tracks.points, np.ones(len(tracks.points))))
        bundle = adjustment.solve(Bundle(self.poses_cam[:, :3, :3], self.poses_cam[:, :3, 3], points)).bundle
        poses_cam = rigid_motions(bundle.R_world_cam, bundle.centres)
        factor, relative = float(np.exp(bundle.log_focal)), np.linalg.inv(poses_se3) @ poses_cam
        mean = Rotation.from_matrix(relative[:, :3, :3]).mean().as_matrix()
        mounted = self.mounted._replace(
            camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor),
            T_pose_cam=rigid_motions(mean, np.median(relative[:, :3, 3], axis=0)),
        )
        off = np.abs(priors._replace(poses=poses_se3 @ mounted.T_pose_cam).deviations(bundle))
        spread = np.repeat([np.median(off[:, :3]), np.median(off[:, 3:])], 3) / MAD_OF_NORMAL
        sigmas = np.maximum(spread, MAP_POSES.least_sigma * self.sigmas)
        return replace(self, mounted=mounted, poses_cam=poses_cam, sigmas=sigmas)

    def corrections(self, poses_se3: FloatArray) -> FloatArray:
        """Differences (n, 6) from the given poses, in the given frame: metres and a rotation vector, world."""
        poses = self.poses_cam @ np.linalg.inv(self.mounted.T_pose_cam)
        turns = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(poses_se3[:, :3, :3], 1, 2)).as_rotvec()
        return np.concatenate((poses[:, :3, 3] - poses_se3[:, :3, 3], turns), axis=1)


def choose_tracks(chunks: Sequence[TriangulatedRays], n_frames: int, tolerance: float) -> Tracks:
    """Long tracks, so many that each frame has enough.

    A corner is in one track at most, so no observation counts twice.
    """
    agreeing = [_agreeing(chunk, tolerance) for chunk in chunks]
    chosen = list(zip(chunks, agreeing, strict=True))
    ray_number = np.concatenate([chunk.rays.number[keep] for chunk, keep in chosen])
    own_number = np.concatenate(
        [chunk.rays.number[chunk.rays.first[chunk.rays.corner]][keep] for chunk, keep in chosen]
    )
    frame = np.concatenate([chunk.rays.camera[keep] for chunk, keep in chosen])
    plane = np.concatenate([chunk.rays.plane[keep] for chunk, keep in chosen])
    points = np.concatenate([chunk.points.xyz[chunk.rays.corner[keep]] for chunk, keep in chosen])
    starts = np.flatnonzero(np.diff(own_number, prepend=-1))
    counts = np.diff(np.append(starts, len(own_number)))
    used = np.zeros(int(max(ray_number.max(initial=0), own_number.max(initial=0))) + 1, dtype=bool)
    tracks_per_frame = np.zeros(n_frames, int)
    rows: list[IntArray] = []
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= MAP_POSES.least_views]
    for start, end in zip(starts[order].tolist(), (starts + counts)[order].tolist(), strict=True):
        if used[own_number[start]]:
            continue
        unused = np.arange(start, end)[~used[ray_number[start:end]]]
        if len(unused) >= MAP_POSES.least_views and tracks_per_frame[frame[unused]].min() < MAP_POSES.tracks:
            used[ray_number[unused]] = True
            tracks_per_frame[frame[unused]] += 1
            rows.append(unused)
    if not rows:
        return Tracks(np.empty((0, 3)), np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    every, point = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(track) for track in rows])
    return Tracks(points[[track[0] for track in rows]], point, frame[every], plane[every])


def _agreeing(chunk: TriangulatedRays, tolerance: float) -> BoolArray:
    """Which rays (m,) agree with the point of their corner."""
    rays = chunk.rays
    R = rays.R_world_cam[rays.camera]
    local = np.einsum("mba,mb->ma", R, np.nan_to_num(chunk.points.xyz[rays.corner]) - rays.centres[rays.camera])
    ahead = local[:, 2] > 0
    plane = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    near = np.linalg.norm(plane - rays.plane, axis=1) < tolerance
    return np.asarray(chunk.points.reliable[rays.corner] & ahead & near)
