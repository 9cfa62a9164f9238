"""A map of landmarks from frames with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.progress import Progress
from conformodal.localization.local_features import DESCRIPTOR_BYTES, LocalFeatures, Matcher
from conformodal.localization.settings import MAPPING
from conformodal.poses import PinholeCamera

from .camera_fit import Matches, fit_camera
from .keyframes import LandmarkMap
from .triangulation import Rays, triangulate


def build_map(
    features: Sequence[LocalFeatures],
    poses_se3: FloatArray,
    camera: PinholeCamera,
    depth_m: float,
    progress: Progress | None = None,
    matcher: Matcher | None = None,
) -> LandmarkMap:
    """Triangulate corners of n frames with known poses (n, 4, 4); a shared `matcher` reuses matches of other maps."""
    pairs = _matched(features, _partners(poses_se3, depth_m), matcher or Matcher(), progress)
    mounted = fit_camera(_some_matches(features, pairs), poses_se3, camera, depth_m)
    poses = poses_se3 @ mounted.T_pose_cam
    tolerance = 2 * MAPPING.tolerance_px / (mounted.camera.fx + mounted.camera.fy)
    points, descriptors = [np.empty((0, 3))], [np.empty((0, DESCRIPTOR_BYTES), np.uint8)]
    starts = [0]
    for i, found in enumerate(pairs):
        here, sound = triangulate(_rays(i, found, features, poses, mounted.camera), tolerance)
        points.append(here[sound])
        descriptors.append(features[i].descriptors[sound])
        starts.append(starts[-1] + int(sound.sum()))
    return LandmarkMap(
        camera=mounted.camera,
        T_pose_cam=mounted.T_pose_cam,
        poses_se3=poses_se3,
        global_descriptors=np.array([d.global_descriptor for d in features], dtype=np.float16),
        starts=np.array(starts),
        points_xyz=np.concatenate(points).astype(np.float32),
        descriptors=np.concatenate(descriptors),
        depth_m=depth_m,
        corrections=np.full((len(features), 6), np.nan),
    )


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
    seen = plane * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ahead & (seen >= 0).all(axis=2) & (seen < (camera.width, camera.height)).all(axis=2)
    return np.asarray(inside.mean(axis=1))


def _partners(poses_se3: FloatArray, depth_m: float) -> list[IntArray]:
    """For each frame, others that see the same scene from other positions; the best first."""
    centres, forward = poses_se3[:, :3, 3], poses_se3[:, :3, 2]
    found = []
    for centre, ahead in zip(centres, forward, strict=True):
        turned = np.arccos(np.clip(forward @ ahead, -1, 1))
        apart = np.linalg.norm(centres - centre, axis=1) / depth_m
        others = np.flatnonzero(
            (turned < MAPPING.most_turned_rad) & (apart > MAPPING.nearest) & (apart < MAPPING.farthest)
        )
        cost = np.abs(np.log(apart[others] / MAPPING.best)) + turned[others] / MAPPING.usual_turn_rad
        others = others[np.argsort(cost, kind="stable")[: 5 * MAPPING.partners]]
        # neighbours in time say the same: take one of every few
        found.append(others[:: max(1, len(others) // MAPPING.partners)][: MAPPING.partners])
    return found


def _matched(
    features: Sequence[LocalFeatures], partners: Sequence[IntArray], matcher: Matcher, progress: Progress | None
) -> list[list[tuple[int, IntArray]]]:
    """For each frame, its partners and those whose partner it is, each with the corners that both see."""
    found: list[list[tuple[int, IntArray]]] = [[] for _ in features]
    done: set[tuple[int, int]] = set()
    for i, others in enumerate(partners):
        for j in others.tolist():
            first, second = min(i, j), max(i, j)
            if (first, second) not in done:
                done.add((first, second))
                pairs = matcher(features[first], features[second])
                found[first].append((second, pairs))
                found[second].append((first, pairs[:, ::-1]))
        if progress is not None:
            progress(i + 1, len(features))
    return found


def _some_matches(features: Sequence[LocalFeatures], pairs: Sequence[Sequence[tuple[int, IntArray]]]) -> Matches:
    rng = np.random.default_rng(0)
    frames, pixels = [np.empty((0, 2), np.int64)], [np.empty((0, 2, 2))]
    for i, others in enumerate(pairs):
        for j, found in others:
            some = found[rng.permutation(len(found))[: MAPPING.matches_per_pair]]
            frames.append(np.tile([i, j], (len(some), 1)))
            pixels.append(np.stack((features[i].pixels[some[:, 0]], features[j].pixels[some[:, 1]]), axis=1))
    return Matches(np.concatenate(frames), np.concatenate(pixels))


def _rays(
    i: int,
    found: Sequence[tuple[int, IntArray]],
    features: Sequence[LocalFeatures],
    poses_cam: FloatArray,
    camera: PinholeCamera,
) -> Rays:
    n, cameras = len(features[i].pixels), [i, *(j for j, _ in found)]
    pixels, seen = np.zeros((n, len(cameras), 2)), np.zeros((n, len(cameras)), dtype=bool)
    pixels[:, 0], seen[:, 0] = features[i].pixels, True
    for k, (j, pair) in enumerate(found, start=1):
        pixels[pair[:, 0], k], seen[pair[:, 0], k] = features[j].pixels[pair[:, 1]], True
    poses = poses_cam[cameras]
    return Rays(camera.on_plane(pixels), seen, poses[:, :3, :3], poses[:, :3, 3])
