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
from conformodal.geometry.adjustment import INVERSE_DEPTHS, MEDIAN_OF_NORM2, Adjustment, Bundle, ObservedCorners
from conformodal.geometry.triangulation import Rays, triangulate

from .relative_pose import estimate_relative_motion
from .tracker import TrackedCorners

_MIN_SHARE, _MIN_CORNERS = 0.3, 40  # a submap ends where a smaller share of its corners is left, or fewer
_MAX_SPAN = 60  # frames
_MAX_CAMERAS = 9  # the anchor included; frames between these add little
_MAX_CORNERS = 250  # that are triangulated
# errors over what the residuals predict (redkitchen, a corridor, KITTI 06): shutter and drift are common to all
_POSITION_FACTOR, _ROTATION_FACTOR = 4.5, 35.0
_WORST_SIGMA = 0.5  # predicted standard deviation over the longest distance, above which a submap is dropped
_SIGMA_PX, _MIN_RESIDUAL_PX = 0.5, 0.1  # of a corner
_CAUCHY = 2.8  # sigmas beyond which residuals are down-weighted
_ITERATIONS, _ENOUGH = 20, 1e-5  # of bundle adjustment, and the relative decrease of the cost that ends it
_AGREE_PX, _MIN_AGREEING = 2.0, 0.6  # a corner agrees if it is reprojected within this; the share that must
_RANSAC = {"max_reproj_error": 3.0, "max_iterations": 200, "min_iterations": 10, "seed": 0}
_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 0.5}


def build_submaps(corners: Sequence[TrackedCorners], camera: PinholeCamera) -> list[Submap]:
    """Submaps of a recording, from the corners of its frames in order of time.

    Frames are numbered by their index in `corners`. There is no submap where the camera stands still, only turns or
    sees nothing.
    """
    submaps: list[Submap] = []
    anchor, n = 0, len(corners)
    while anchor < n - 2:
        last = _reach(corners, anchor)
        submap = _longest(corners, anchor, last, camera)
        if submap is not None:
            submaps.append(submap)
            last = int(submap.frames[-1])
        if last == n - 1:
            break
        anchor = max(anchor + 1, (anchor + last) // 2)
    return submaps


def _longest(corners: Sequence[TrackedCorners], anchor: int, last: int, camera: PinholeCamera) -> Submap | None:
    """The submap from an anchor to a frame, or to one half as far where that fails, and so on; None if all fail."""
    while last > anchor + 1:
        frames = np.unique(np.linspace(anchor, last, _MAX_CAMERAS).round().astype(np.int64))
        submap = _submap([corners[f] for f in frames], frames, camera)
        if submap is not None:
            return submap
        last = (anchor + last) // 2
    return None


def _reach(corners: Sequence[TrackedCorners], anchor: int) -> int:
    """The last frame that still sees enough of the anchor's corners."""
    ids = corners[anchor].ids
    enough = max(_MIN_SHARE * len(ids), _MIN_CORNERS)
    last = anchor
    for t in range(anchor + 1, min(len(corners), anchor + _MAX_SPAN)):
        if np.isin(ids, corners[t].ids, assume_unique=True).sum() < enough:
            break
        last = t
    return last


def _submap(corners: Sequence[TrackedCorners], frames: IntArray, camera: PinholeCamera) -> Submap | None:
    views = _match_views(corners, camera)
    in_last = views.visible[-1]
    motion = estimate_relative_motion(views.raw_anchor[in_last], views.raw_last[in_last], camera)
    if motion.status is not MotionStatus.OK or motion.R_prev_next is None or motion.direction_prev is None:
        return None
    start = _first_guess(views, motion.R_prev_next, motion.direction_prev, camera)
    if start is None:
        return None
    pixel = 2.0 / (camera.fx + camera.fy)
    frame, corner = np.nonzero(views.visible)
    fit = Adjustment(
        ObservedCorners(frame, corner, camera.on_plane(views.others[frame, corner])),
        sigma=_SIGMA_PX * pixel,
        cauchy=_CAUCHY,
        unknown=INVERSE_DEPTHS,
        iterations=_ITERATIONS,
        enough=_ENOUGH,
    ).solve(start)
    errors = np.linalg.norm(fit.residuals, axis=1) * _SIGMA_PX * pixel
    length = max(float(np.linalg.norm(fit.bundle.centres[-1])), 1e-12)
    inverse_depths = fit.bundle.points[:, 3] * length
    ahead = inverse_depths > 0
    if min(np.mean(errors < _AGREE_PX * pixel), np.mean(ahead)) < _MIN_AGREEING:
        return None
    error = max(float(np.median(errors)) / MEDIAN_OF_NORM2, _MIN_RESIDUAL_PX * pixel)
    depth = 1 / float(np.median(inverse_depths[ahead]))
    positions = np.concatenate((np.zeros((1, 3)), fit.bundle.centres / length))
    sigma = _POSITION_FACTOR * error * depth
    if sigma > _WORST_SIGMA * np.linalg.norm(positions, axis=1).max():
        return None
    rotations = np.concatenate((np.eye(3)[None], fit.bundle.R_world_cam))
    return Submap(frames, rotations, positions, depth, sigma, _ROTATION_FACTOR * error)


class _Views(NamedTuple):
    """Pixels without distortion of the anchor's corners (n, 2) and of the same in the k other frames (k, n, 2).

    What is not `visible` (k, n) has no meaning. `raw_anchor` and `raw_last` are pixels as they are in the images.
    """

    anchor: FloatArray
    others: FloatArray
    visible: BoolArray
    raw_anchor: FloatArray
    raw_last: FloatArray


def _match_views(corners: Sequence[TrackedCorners], camera: PinholeCamera) -> _Views:
    first, *others = corners
    pixels = np.zeros((len(others), len(first.ids), 2))
    visible = np.zeros(pixels.shape[:2], dtype=bool)
    for k, other in enumerate(others):
        _, here, there = np.intersect1d(first.ids, other.ids, assume_unique=True, return_indices=True)
        pixels[k, here], visible[k, here] = other.pixels[there], True
    # the longest tracks are the most informative
    best = np.sort(np.argsort(-visible.sum(axis=0), kind="stable")[:_MAX_CORNERS])
    best = best[visible[:, best].any(axis=0)]
    anchor, pixels = first.pixels[best].astype(np.float64), pixels[:, best]
    undistorted = camera.undistort(pixels.reshape(-1, 2)).reshape(pixels.shape)
    return _Views(camera.undistort(anchor), undistorted, visible[:, best], anchor, pixels[-1])


def _first_guess(
    views: _Views, R_anchor_last: FloatArray, direction: FloatArray, camera: PinholeCamera
) -> Bundle | None:
    """Depths from the first and the last camera, then the cameras between from the depths."""
    rays = np.column_stack((camera.on_plane(views.anchor), np.ones(len(views.anchor))))
    inverse = _inverse_depths(views, R_anchor_last, direction, camera)
    sound = inverse > _MIN_RESIDUAL_PX / camera.fx
    if sound.sum() < _MIN_CORNERS / 2:
        return None
    model = camera.poselib()
    rotations, centres = [], []
    for pixels, visible in zip(views.others[:-1], views.visible[:-1], strict=True):
        use = sound & visible
        if use.sum() < _MIN_CORNERS / 2:
            return None
        points = rays[use] / inverse[use, None]
        pose, _ = poselib.estimate_absolute_pose(pixels[use], points, model, _RANSAC, _REFINEMENT)
        rotations.append(np.asarray(pose.R).T)
        centres.append(-rotations[-1] @ np.asarray(pose.t))
    inverse = np.where(sound, inverse, np.median(inverse[sound]))
    points = np.column_stack((rays, inverse))
    bundle = Bundle(np.array([*rotations, R_anchor_last]), np.array([*centres, direction]), points)
    return bundle if np.isfinite(bundle.centres).all() else None


def _inverse_depths(views: _Views, R_anchor_last: FloatArray, centre: FloatArray, camera: PinholeCamera) -> FloatArray:
    """(n,) from the anchor and the last camera; NaN for corners that are not seen by both, or not as one point."""
    corners = np.flatnonzero(views.visible[-1])
    plane = camera.on_plane(np.stack((views.anchor[corners], views.others[-1, corners]), axis=1))
    rays = Rays(
        corner=np.repeat(np.arange(len(corners)), 2),
        number=np.arange(2 * len(corners)),
        camera=np.tile([0, 1], len(corners)),
        plane=plane.reshape(-1, 2),
        R_world_cam=np.stack((np.eye(3), R_anchor_last)),
        centres=np.stack((np.zeros(3), centre)),
    )
    inverse = np.full(len(views.anchor), np.nan)
    inverse[corners] = 1 / triangulate(rays, _AGREE_PX / camera.fx).xyz[:, 2]
    return inverse
