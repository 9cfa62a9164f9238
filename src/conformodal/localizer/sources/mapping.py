"""Landmarks from frames with known poses: matching, the camera, triangulation and adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from conformodal.core.parallel import in_threads
from conformodal.core.progress import Progress
from conformodal.features.local import Descriptors, LocalFeatures, Matcher
from conformodal.geometry import PinholeCamera
from conformodal.geometry.map_poses import (
    MIN_PER_FRAME,
    SIGMA_DEPTHS,
    SIGMA_RAD,
    InlierRays,
    MapPoses,
    Matches,
    RigCalibration,
    Tracks,
    choose_tracks,
    fit_camera,
    inlier_rays,
)
from conformodal.geometry.triangulation import Points, Rays, triangulate
from conformodal.localizer.landmark_settings import LandmarkMapSettings


class TriangulatedFrames(NamedTuple):
    """The camera of n frames and their landmarks, as :class:`.landmark_map.LandmarkMap` keeps them."""

    rig: RigCalibration
    starts: IntArray
    points_xyz: Float32Array
    descriptors: Descriptors
    corrections: FloatArray


def triangulate_frames(
    features: Sequence[LocalFeatures],
    poses_se3: FloatArray,
    camera: PinholeCamera,
    depth_m: float,
    progress: Progress | None,
    matcher: Matcher,
    settings: LandmarkMapSettings,
) -> TriangulatedFrames:
    """Triangulate corners of n frames with known poses (n, 4, 4), which are adjusted with them."""
    pairs = _matched(features, _partners(poses_se3, depth_m, settings), matcher, progress)
    rig = fit_camera(_some_matches(features, pairs, settings.matches_per_pair), poses_se3, camera, depth_m)
    features = [one.compensate_rolling_shutter(rig.shutter, camera) for one in features]
    work = _Triangulation(features, pairs, settings)
    sigmas = np.repeat([SIGMA_RAD, SIGMA_DEPTHS * depth_m], 3)
    current = MapPoses(rig, poses_se3 @ rig.T_pose_cam, sigmas)
    for _ in range(settings.rounds):
        tracks = work.tracks(current)
        if len(tracks.frame) < MIN_PER_FRAME * len(features):
            break
        current = current.adjusted(poses_se3, tracks)
    return work.triangulated(current, poses_se3)


class KnownFrames(NamedTuple):
    """Frames of a map that others are added to."""

    features: Sequence[LocalFeatures]  # of n frames: corners whose landmarks are known
    poses_se3: FloatArray  # (n, 4, 4) as given
    poses_cam: FloatArray  # (n, 4, 4) adjusted, ``T_world_cam``
    rig: RigCalibration
    sigmas: FloatArray  # (6,) of given poses, see MapPoses


def triangulate_beside(
    known: KnownFrames,
    features: Sequence[LocalFeatures],
    poses_se3: FloatArray,
    depth_m: float,
    progress: Progress | None,
    settings: LandmarkMapSettings,
) -> TriangulatedFrames:
    """Triangulate corners of m more frames with known poses (m, 4, 4), in a map whose poses and camera stay.

    Their corners are sought in frames of the map and in each other.
    """
    n, rig = len(known.features), known.rig
    features = [one.compensate_rolling_shutter(rig.shutter, rig.camera) for one in features]
    every = [*known.features, *features]
    partners = _partners(np.concatenate((known.poses_se3, poses_se3)), depth_m, settings)
    partners[:n] = [np.empty(0, np.int64)] * n
    work = _Triangulation(every, _matched(every, partners, Matcher(), progress), settings, first=n)
    expected = poses_se3 @ rig.T_pose_cam
    current = MapPoses(rig, np.concatenate((known.poses_cam, expected)), known.sigmas)
    for _ in range(settings.rounds):
        tracks = work.tracks(current)
        if len(tracks.frame) < MIN_PER_FRAME * len(features):
            break
        current = current.adjusted_beside(n, expected, tracks)
    return work.triangulated(current, poses_se3)


class _Triangulation:
    """Triangulates the corners of the frames from `first` on, from their matches with all frames."""

    def __init__(
        self,
        features: Sequence[LocalFeatures],
        pairs: Sequence[Sequence[tuple[int, IntArray]]],
        settings: LandmarkMapSettings,
        first: int = 0,
    ) -> None:
        self._features, self._pairs, self._settings, self._first = features, pairs, settings, first
        self._before = np.concatenate(([0], np.cumsum([len(f.pixels) for f in features])))
        n, at_a_time = len(features), settings.frames_at_a_time
        self._chunks = [range(a, min(a + at_a_time, n)) for a in range(first, n, at_a_time)]

    def tracks(self, current: MapPoses) -> Tracks:
        """Tracks that adjust poses."""

        def sightings(few: range) -> InlierRays:
            rays = self._rays(current, [(i, self._most_seen(i)) for i in few])
            return inlier_rays(rays, triangulate(rays, self._tolerance(current)), self._tolerance(current))

        return choose_tracks(in_threads(sightings, self._chunks), len(self._features))

    def triangulated(self, current: MapPoses, poses_se3: FloatArray) -> TriangulatedFrames:
        """The landmarks of the frames, whose given poses are `poses_se3` (m, 4, 4)."""

        def landmarks(few: range) -> Points:
            return self._strongest(few, current)

        points = Points(*map(np.concatenate, zip(*in_threads(landmarks, self._chunks), strict=True)))
        starts = self._before[self._first :] - self._before[self._first]
        reliable = _first_of_frames(points.reliable, starts, self._settings.max_landmarks)
        return TriangulatedFrames(
            rig=current.rig,
            starts=np.concatenate(([0], np.cumsum(reliable)))[starts],
            points_xyz=points.xyz[reliable].astype(np.float32),
            descriptors=np.concatenate([one.descriptors for one in self._features[self._first :]])[reliable],
            corrections=replace(current, poses_cam=current.poses_cam[self._first :]).corrections(poses_se3),
        )

    def _strongest(self, few: range, current: MapPoses) -> Points:
        """Points of all corners of some frames; none of those that are weaker than the landmarks which are kept."""
        counts = [len(self._features[i].pixels) for i in few]
        points = Points(np.full((sum(counts), 3), np.nan), np.zeros(sum(counts), dtype=np.bool_))
        starts = np.concatenate(([0], np.cumsum(counts)))
        short = dict.fromkeys(range(len(few)), 0)  # frames, and the first corner that was not tried
        for end in (self._settings.tried_first, max(counts)):
            rows = [(k, np.arange(first, min(end, counts[k]))) for k, first in short.items() if first < counts[k]]
            if rows:
                found = triangulate(self._rays(current, [(few[k], at) for k, at in rows]), self._tolerance(current))
                at = np.concatenate([starts[k] + at for k, at in rows])
                points.xyz[at], points.reliable[at] = found
            n_reliable = np.diff(np.concatenate(([0], np.cumsum(points.reliable)))[starts])
            short = {k: end for k in short if n_reliable[k] < self._settings.max_landmarks}
        return points

    def _most_seen(self, i: int) -> IntArray:
        """The corners of a frame that most others see, in order."""
        corners = np.concatenate([np.empty(0, np.int64), *(pair[:, 0] for _, pair in self._pairs[i])])
        often = np.bincount(corners, minlength=len(self._features[i].pixels))
        return np.sort(np.argsort(-often, kind="stable")[: self._settings.max_tracked])

    def _rays(self, current: MapPoses, chosen: Sequence[tuple[int, IntArray]]) -> Rays:
        """Rays of some corners of some frames."""
        corners, cameras, pixels, others, before = [], [], [], [], 0
        for i, rows in chosen:
            n = len(self._features[i].pixels)
            place = np.full(n, -1)
            place[rows] = before + np.arange(len(rows))
            before += len(rows)
            for j, every in [(i, np.tile(np.arange(n)[:, None], 2)), *self._pairs[i]]:
                pair = every[place[every[:, 0]] >= 0]
                corners.append(place[pair[:, 0]])
                cameras.append(np.full(len(pair), j))
                pixels.append(self._features[j].pixels[pair[:, 1]])
                others.append(self._before[j] + pair[:, 1])
        corner = np.concatenate(corners)
        order = np.argsort(corner, kind="stable")  # the corner's own frame stays first
        plane = current.rig.camera.on_plane(np.concatenate(pixels)[order])
        camera_of, ray_number = np.concatenate(cameras)[order], np.concatenate(others)[order]
        poses_cam = current.poses_cam
        return Rays(corner[order], ray_number, camera_of, plane, poses_cam[:, :3, :3], poses_cam[:, :3, 3])

    def _tolerance(self, current: MapPoses) -> float:
        """Radians by which a ray may miss a landmark."""
        camera = current.rig.camera
        return 2 * self._settings.tolerance_px / (camera.fx + camera.fy)


def _first_of_frames(reliable: BoolArray, starts: IntArray, most: int) -> BoolArray:
    """The first `most` reliable corners of each frame; the detector gives the strongest first."""
    count = np.concatenate(([0], np.cumsum(reliable)))
    frame = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return reliable & (count[:-1] - count[starts[frame]] < most)


def view_overlap(poses_se3: FloatArray, i: int, camera: PinholeCamera, depth_m: float) -> FloatArray:
    """Shares (n,) of what frame `i` sees that other frames see too, from their poses (n, 4, 4) ``T_world_cam``.

    What it sees is a grid of pixels at half, once and twice the depth; occlusion is ignored.
    """
    # middles of cells: at the image's edges rounding would decide, and a frame would not see all that it sees
    across, down = ((np.arange(count) + 0.5) * side / count for side, count in ((camera.width, 5), (camera.height, 4)))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = np.column_stack((camera.on_plane(pixels), np.ones(len(pixels))))
    points = np.concatenate([rays * (depth_m * times) for times in (0.5, 1.0, 2.0)])
    world = points @ poses_se3[i, :3, :3].T + poses_se3[i, :3, 3]
    local = (world - poses_se3[:, None, :3, 3]) @ poses_se3[:, :3, :3]
    ahead = local[..., 2] > 1e-6
    plane = local[..., :2] / np.where(ahead, local[..., 2], 1.0)[..., None]
    pixels_seen = plane * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ahead & (pixels_seen >= 0).all(axis=2) & (pixels_seen < (camera.width, camera.height)).all(axis=2)
    return np.asarray(inside.mean(axis=1))


def _partners(poses_se3: FloatArray, depth_m: float, settings: LandmarkMapSettings) -> list[IntArray]:
    """For each frame, others that see the same scene from other positions; the best first."""
    centres, forward = poses_se3[:, :3, 3], poses_se3[:, :3, 2]
    partners = []
    for centre, ahead in zip(centres, forward, strict=True):
        turned = np.arccos(np.clip(forward @ ahead, -1, 1))
        apart = np.linalg.norm(centres - centre, axis=1) / depth_m
        inside = (apart > settings.nearest_depths) & (apart < settings.farthest_depths)
        others = np.flatnonzero((turned < settings.max_turned_rad) & inside)
        cost = np.abs(np.log(apart[others] / settings.best_depths)) + turned[others] / settings.usual_turn_rad
        others = others[np.argsort(cost, kind="stable")[: 5 * settings.partners]]
        # neighbours in time say the same: take one of every few
        partners.append(others[:: max(1, len(others) // settings.partners)][: settings.partners])
    return partners


def _matched(
    features: Sequence[LocalFeatures], partners: Sequence[IntArray], matcher: Matcher, progress: Progress | None
) -> list[list[tuple[int, IntArray]]]:
    """For each frame, its partners and those whose partner it is, each with the corners that both see."""
    later: list[set[int]] = [set() for _ in features]
    for i, others in enumerate(partners):
        for j in others.tolist():
            later[min(i, j)].add(max(i, j))

    def of(i: int) -> list[tuple[int, IntArray]]:
        others = sorted(later[i])
        return list(zip(others, matcher(features[i], [features[j] for j in others]), strict=True))

    matched = in_threads(of, range(len(features)), progress)
    for i, pairs_of_frame in enumerate(list(map(list, matched))):
        for j, pairs in pairs_of_frame:
            matched[j].append((i, pairs[:, ::-1]))
    return matched


def _some_matches(
    features: Sequence[LocalFeatures], pairs: Sequence[Sequence[tuple[int, IntArray]]], per_pair: int
) -> Matches:
    rng, moving = np.random.default_rng(0), [one.flows for one in features]
    frames, pixels, flows = [np.empty((0, 2), np.int64)], [np.empty((0, 2, 2))], [np.empty((0, 2, 2))]
    for i, others in enumerate(pairs):
        for j, matches in others:
            if i < j:
                some = matches[rng.permutation(len(matches))[:per_pair]]
                frames.append(np.tile([i, j], (len(some), 1)))
                pixels.append(np.stack((features[i].pixels[some[:, 0]], features[j].pixels[some[:, 1]]), axis=1))
                flows.append(np.stack((moving[i][some[:, 0]], moving[j][some[:, 1]]), axis=1))
    return Matches(np.concatenate(frames), np.concatenate(pixels), np.concatenate(flows))
