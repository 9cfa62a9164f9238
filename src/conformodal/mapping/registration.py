"""Poses of the frames between keyframes: points of the map are followed into them, then PnP and its adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, UInt8Array
from conformodal.core.parallel import in_threads
from conformodal.core.progress import Progress
from conformodal.io.decoding import grey_image, read_image
from conformodal.io.diagnosis.flow import track

from .clips import Clip
from .keyframes import SIDE_PX
from .settings import require_pycolmap
from .structure import Structure, world_from_camera

_SIDE_PX = 1280  # longer side of the images in which points are followed
_MAX_ERROR_PX = 4.0  # of images of 640
_MIN_INLIERS, _MIN_SHARE = 24, 0.3
_MIN_POINTS = 12  # that are followed at all


class _Seen(NamedTuple):
    """Points of the map that a keyframe sees."""

    grey: UInt8Array
    pixels: Float32Array  # (m, 1, 2) of the grey image
    xyz: FloatArray  # (m, 3)


class _Gap(NamedTuple):
    """Frames of a clip between two keyframes of the map, or before the first or after the last."""

    clip: Clip
    frames: range
    anchors: tuple[int, ...]


def register_frames(
    clips: Sequence[Clip], images: Path, structure: Structure, progress: Progress | None = None
) -> dict[str, FloatArray]:
    """``T_world_cam`` (4, 4) of all frames that can be placed, by their files; those of keyframes are the map's."""
    poses = structure.poses
    gaps = [gap for clip in clips for gap in _gaps(clip, poses)]
    for found in in_threads(lambda gap: _register_gap(gap, images, structure), gaps, progress) if gaps else []:
        poses |= found
    return poses


def _gaps(clip: Clip, poses: dict[str, FloatArray]) -> list[_Gap]:
    anchors = [k for k in clip.keyframes.tolist() if clip.images[k] in poses]
    if not anchors:
        return []
    bounds = [-1, *anchors, len(clip)]
    gaps = []
    for before, after in pairwise(bounds):
        ends = tuple(k for k in (before, after) if 0 <= k < len(clip))
        if after - before > 1:
            gaps.append(_Gap(clip, range(before + 1, after), ends))
    return gaps


def _register_gap(gap: _Gap, images: Path, structure: Structure) -> dict[str, FloatArray]:
    scale = min(1.0, _SIDE_PX / max(gap.clip.size))
    seen = [_points_seen(gap.clip.images[k], images, structure, scale) for k in gap.anchors]
    camera = structure.camera_of(gap.clip.images[gap.anchors[0]])
    poses = {}
    for k in gap.frames:
        pose = _register(_grey(images / gap.clip.images[k], scale), seen, camera, scale)
        if pose is not None:
            poses[gap.clip.images[k]] = pose
    return poses


def _grey(path: Path, scale: float) -> UInt8Array:
    grey = grey_image(read_image(path))
    if scale == 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _points_seen(name: str, images: Path, structure: Structure, scale: float) -> _Seen:
    image = structure.model.find_image_with_name(name)
    points = [point for point in image.points2D if point.has_point3D()]
    pixels = np.array([point.xy for point in points], dtype=np.float64).reshape(-1, 2)
    xyz = np.array([structure.model.points3D[point.point3D_id].xyz for point in points]).reshape(-1, 3)
    return _Seen(_grey(images / name, scale), (pixels * scale - 0.5).astype(np.float32)[:, None], xyz)


def _register(grey: UInt8Array, seen: Sequence[_Seen], camera: Any, scale: float) -> FloatArray | None:
    """The pose of a frame in which points of keyframes are followed, or None where too few agree."""
    pixels, points = list[FloatArray](), list[FloatArray]()
    for view in seen:
        if len(view.xyz) >= _MIN_POINTS:
            tracked, found = track(view.grey, grey, view.pixels)
            pixels.append(((tracked[found, 0] + 0.5) / scale).astype(np.float64))
            points.append(view.xyz[found])
    if sum(map(len, points)) < _MIN_INLIERS:
        return None
    pycolmap = require_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _MAX_ERROR_PX * max(1.0, max(camera.width, camera.height) / SIDE_PX)
    options.ransac.random_seed = 0
    every = np.concatenate(pixels)
    answer = pycolmap.estimate_and_refine_absolute_pose(every, np.concatenate(points), camera, options)
    if answer is None or answer["num_inliers"] < max(_MIN_INLIERS, _MIN_SHARE * len(every)):
        return None
    return world_from_camera(answer["cam_from_world"])
