"""Submaps: pieces of the camera's path from corners that are tracked over many frames.

Two frames give a direction; the ratio of steps needs a corner that three or more frames see. A submap starts at an
anchor, ends where most of its corners are lost, and is bundle adjusted on its own. The next one is anchored in its
middle; the frames that both share link their scales.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import poselib

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import MotionStatus, PinholeCamera, Submap
from conformodal.geometry.bundle import Bundle, Views, adjust_bundle, residual_spread
from conformodal.geometry.undistortion import poselib_camera, undistort

from .relative_pose import estimate_relative_motion
from .settings import SUBMAPS
from .tracker import Corners


def build_submaps(corners: Sequence[Corners], camera: PinholeCamera) -> list[Submap]:
    """Submaps of a recording, from the corners of its frames in order of time.

    Frames are numbered by their index in `corners`. There is no submap where the camera stands still, only turns or
    sees nothing.
    """
    found: list[Submap] = []
    anchor, n = 0, len(corners)
    while anchor < n - 2:
        last = _reach(corners, anchor)
        submap = _longest(corners, anchor, last, camera)
        if submap is not None:
            found.append(submap)
            last = int(submap.frames[-1])
        if last == n - 1:
            break
        anchor = max(anchor + 1, (anchor + last) // 2)
    return found


def _longest(corners: Sequence[Corners], anchor: int, last: int, camera: PinholeCamera) -> Submap | None:
    """The submap from an anchor to a frame, or to one half as far where that fails, and so on; None if all fail."""
    while last > anchor + 1:
        frames = np.unique(np.linspace(anchor, last, SUBMAPS.max_cameras).round().astype(np.int64))
        submap = _submap([corners[f] for f in frames], frames, camera)
        if submap is not None:
            return submap
        last = (anchor + last) // 2
    return None


def _reach(corners: Sequence[Corners], anchor: int) -> int:
    """The last frame that still sees enough of the anchor's corners."""
    ids = corners[anchor].ids
    enough = max(SUBMAPS.min_share * len(ids), SUBMAPS.min_corners)
    last = anchor
    for t in range(anchor + 1, min(len(corners), anchor + SUBMAPS.max_span)):
        if np.isin(ids, corners[t].ids, assume_unique=True).sum() < enough:
            break
        last = t
    return last


def _submap(corners: Sequence[Corners], frames: IntArray, camera: PinholeCamera) -> Submap | None:
    common = _matched(corners)
    to_last = common.seen[-1]
    pixels = undistort(common.anchor, camera), np.stack([undistort(p, camera) for p in common.others])
    motion = estimate_relative_motion(common.anchor[to_last], common.others[-1][to_last], camera)
    if motion.status is not MotionStatus.OK or motion.R_prev_next is None or motion.direction_prev is None:
        return None
    views = Views(camera.on_plane(pixels[0]), camera.on_plane(pixels[1]), common.seen)
    start = _first_guess(pixels, views, motion.R_prev_next, motion.direction_prev, camera)
    if start is None:
        return None
    pixel = 2.0 / (camera.fx + camera.fy)
    bundle, residuals = adjust_bundle(start, views, SUBMAPS.sigma_px * pixel)
    agreeing = np.mean(residuals[views.seen] < SUBMAPS.agree_px * pixel)
    depths = bundle.inverse_depths
    ahead = depths > 0
    if agreeing < SUBMAPS.min_agreeing or ahead.mean() < SUBMAPS.min_agreeing:
        return None
    error, depth = (
        max(residual_spread(residuals), SUBMAPS.least_residual_px * pixel),
        1 / float(np.median(depths[ahead])),
    )
    positions = np.concatenate((np.zeros((1, 3)), bundle.positions))
    sigma = SUBMAPS.position_factor * error * depth
    if sigma > SUBMAPS.worst_sigma * np.linalg.norm(positions, axis=1).max():
        return None
    turned = np.concatenate((np.eye(3)[None], bundle.R_anchor_frame))
    return Submap(frames, turned, positions, depth, sigma, SUBMAPS.rotation_factor * error)


class _Matched(NamedTuple):
    """The anchor's corners (n, 2), where the other frames see them (k, n, 2), and whether they do (k, n); pixels."""

    anchor: FloatArray
    others: FloatArray
    seen: BoolArray


def _matched(corners: Sequence[Corners]) -> _Matched:
    first, *others = corners
    places = np.zeros((len(others), len(first.ids), 2))
    seen = np.zeros(places.shape[:2], dtype=bool)
    for k, other in enumerate(others):
        _, here, there = np.intersect1d(first.ids, other.ids, assume_unique=True, return_indices=True)
        places[k, here], seen[k, here] = other.pixels[there], True
    # the longest tracks are the most informative
    best = np.sort(np.argsort(-seen.sum(axis=0), kind="stable")[: SUBMAPS.max_corners])
    best = best[seen[:, best].any(axis=0)]
    return _Matched(first.pixels[best].astype(np.float64), places[:, best], seen[:, best])


def _first_guess(
    pixels: tuple[FloatArray, FloatArray],
    views: Views,
    R_anchor_last: FloatArray,
    direction: FloatArray,
    camera: PinholeCamera,
) -> Bundle | None:
    """Depths from the first and the last camera, then the cameras between from the depths."""
    to_last = views.seen[-1]
    inverse = _inverse_depths(views, R_anchor_last, direction)
    sound = to_last & (inverse > SUBMAPS.least_residual_px / camera.fx)
    if sound.sum() < SUBMAPS.min_corners / 2:
        return None
    model = poselib_camera(camera)
    rays = np.column_stack((views.anchor, np.ones(len(views.anchor))))
    turned, centres = [], []
    for here, seen in zip(pixels[1][:-1], views.seen[:-1], strict=True):
        use = sound & seen
        if use.sum() < SUBMAPS.min_corners / 2:
            return None
        points = rays[use] / inverse[use, None]
        pose, _ = poselib.estimate_absolute_pose(here[use], points, model, SUBMAPS.ransac, SUBMAPS.refinement)
        R_anchor_frame = np.asarray(pose.R).T
        turned.append(R_anchor_frame)
        centres.append(-R_anchor_frame @ np.asarray(pose.t))
    inverse = np.where(sound, inverse, np.median(inverse[sound]))
    bundle = Bundle(np.array([*turned, R_anchor_last]), np.array([*centres, direction]), inverse)
    return bundle if np.isfinite(bundle.positions).all() else None


def _inverse_depths(views: Views, R_anchor_last: FloatArray, centre: FloatArray) -> FloatArray:
    """(n,) linear triangulation: the ray in the last camera is parallel to ``R^T (ray - inverse depth * centre)``."""
    ones = np.ones((len(views.anchor), 1))
    there = np.concatenate((views.others[-1], ones), axis=1)
    a = np.cross(there, np.concatenate((views.anchor, ones), axis=1) @ R_anchor_last)
    b = np.cross(there, centre @ R_anchor_last)
    return np.asarray((a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-12))
