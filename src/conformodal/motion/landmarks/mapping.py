"""A map of landmarks from frames with known poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera

from .camera_fit import Matches, fit_camera
from .described import DESCRIPTOR_BYTES, Described, Matcher
from .keyframes import LandmarkMap
from .triangulation import Rays, triangulate

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Progress = Callable[[int, int], None]

# A frame's corners are looked for in so many others, which look the same way from another place; pairs serve both.
PARTNERS = 10
_MOST_TURNED_RAD = np.radians(35.0)
_USUAL_TURN_RAD = np.radians(15.0)
# Distances between partners, in units of the scene's depth: too near says nothing of depths, too far sees other things.
_NEAREST, _BEST, _FARTHEST = 0.02, 0.15, 0.8
_TOLERANCE_PX = 4.0
_MATCHES_A_PAIR = 40  # to fit the camera with


def build_map(
    described: Sequence[Described],
    poses_se3: FloatArray,
    camera: PinholeCamera,
    depth_m: float,
    progress: Progress | None = None,
    matcher: Matcher | None = None,
) -> LandmarkMap:
    """Place the corners of frames with known poses in the world.

    Parameters
    ----------
    described
        n frames.
    poses_se3
        (n, 4, 4) their poses, ``T_world_cam``.
    camera
        As the data set has it.
    depth_m
        Median depth of the corners in view.
    progress
        Called with frames done and frames in all.
    matcher
        Of another map with some of these frames, whose pairs need not be looked for again.
    """
    pairs = _matched(described, _partners(poses_se3, depth_m), matcher or Matcher(), progress)
    mounted = fit_camera(_some_matches(described, pairs), poses_se3, camera, depth_m)
    poses = poses_se3 @ mounted.T_pose_cam
    tolerance = 2 * _TOLERANCE_PX / (mounted.camera.fx + mounted.camera.fy)
    points, kept = [np.empty((0, 3))], [np.empty((0, DESCRIPTOR_BYTES), np.uint8)]
    starts = [0]
    for i, found in enumerate(pairs):
        here, sound = triangulate(_rays(i, found, described, poses, mounted.camera), tolerance)
        points.append(here[sound])
        kept.append(described[i].descriptors[sound])
        starts.append(starts[-1] + int(sound.sum()))
    return LandmarkMap(
        camera=mounted.camera,
        T_pose_cam=mounted.T_pose_cam,
        poses_se3=poses_se3,
        thumbnails=np.array([d.thumbnail for d in described], dtype=np.float16),
        starts=np.array(starts),
        points_xyz=np.concatenate(points).astype(np.float32),
        descriptors=np.concatenate(kept),
        depth_m=depth_m,
        corrections=np.full((len(described), 6), np.nan),
    )


def _partners(poses_se3: FloatArray, depth_m: float) -> list[IntArray]:
    """For each frame, others that see the same things from elsewhere; the best first."""
    centres, forward = poses_se3[:, :3, 3], poses_se3[:, :3, 2]
    found = []
    for centre, ahead in zip(centres, forward, strict=True):
        turned = np.arccos(np.clip(forward @ ahead, -1, 1))
        apart = np.linalg.norm(centres - centre, axis=1) / depth_m
        others = np.flatnonzero((turned < _MOST_TURNED_RAD) & (apart > _NEAREST) & (apart < _FARTHEST))
        cost = np.abs(np.log(apart[others] / _BEST)) + turned[others] / _USUAL_TURN_RAD
        others = others[np.argsort(cost, kind="stable")[: 5 * PARTNERS]]
        # neighbours in time say the same: take one of every few
        found.append(others[:: max(1, len(others) // PARTNERS)][:PARTNERS])
    return found


def _matched(
    described: Sequence[Described], partners: Sequence[IntArray], matcher: Matcher, progress: Progress | None
) -> list[list[tuple[int, IntArray]]]:
    """For each frame, its partners and those whose partner it is, each with the corners that both see."""
    found: list[list[tuple[int, IntArray]]] = [[] for _ in described]
    done: set[tuple[int, int]] = set()
    for i, others in enumerate(partners):
        for j in others.tolist():
            first, second = min(i, j), max(i, j)
            if (first, second) not in done:
                done.add((first, second))
                pairs = matcher(described[first], described[second])
                found[first].append((second, pairs))
                found[second].append((first, pairs[:, ::-1]))
        if progress is not None:
            progress(i + 1, len(described))
    return found


def _some_matches(described: Sequence[Described], pairs: Sequence[Sequence[tuple[int, IntArray]]]) -> Matches:
    rng = np.random.default_rng(0)
    frames, pixels = [np.empty((0, 2), np.int64)], [np.empty((0, 2, 2))]
    for i, others in enumerate(pairs):
        for j, found in others:
            some = found[rng.permutation(len(found))[:_MATCHES_A_PAIR]]
            frames.append(np.tile([i, j], (len(some), 1)))
            pixels.append(np.stack((described[i].pixels[some[:, 0]], described[j].pixels[some[:, 1]]), axis=1))
    return Matches(np.concatenate(frames), np.concatenate(pixels))


def _rays(
    i: int,
    found: Sequence[tuple[int, IntArray]],
    described: Sequence[Described],
    poses_cam: FloatArray,
    camera: PinholeCamera,
) -> Rays:
    n, cameras = len(described[i].pixels), [i, *(j for j, _ in found)]
    pixels, seen = np.zeros((n, len(cameras), 2)), np.zeros((n, len(cameras)), dtype=bool)
    pixels[:, 0], seen[:, 0] = described[i].pixels, True
    for k, (j, pair) in enumerate(found, start=1):
        pixels[pair[:, 0], k], seen[pair[:, 0], k] = described[j].pixels[pair[:, 1]], True
    poses = poses_cam[cameras]
    return Rays(camera.on_plane(pixels), seen, poses[:, :3, :3], poses[:, :3, 3])
