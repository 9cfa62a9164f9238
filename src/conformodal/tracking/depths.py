"""The depth of what a camera sees, measured in frames with known poses; it gives submaps and maps their scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import IntArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.features.local import ORB, Detector, extract_local_features, match
from conformodal.geometry import matrix_from_quat_wxyz
from conformodal.geometry.adjustment import MAD_OF_NORMAL
from conformodal.geometry.triangulation import Rays, triangulate
from conformodal.io import Recording
from conformodal.io.decoding import grey_image

from .submaps import build_submaps
from .tracker import CornerTracker

_STRETCHES, _FRAMES = 10, 12  # that the depth is measured on, spread over all training frames, and frames of each
_GAP = 4.0  # a stretch ends at a gap longer than the median one by this factor
_MIN_SUBMAPS = 5  # with fewer, or fewer pairs, the depth is not known
# Pairs of frames whose corners are matched where none can be tracked, reliable points of a pair, and their tolerance
_PAIRS, _MIN_POINTS, _TOLERANCE_PX = 40, 20, 4.0
_MIN_SPREAD = 0.1  # standard deviation of the logarithm of the depth


@dataclass(frozen=True)
class SceneDepth:
    """Depth of what a camera sees in a recording; NaN where it is not known."""

    median_m: float = math.nan
    log_spread: float = math.nan  # standard deviation of its logarithm


UNKNOWN_DEPTH = SceneDepth()


def scene_depth(sequence: Recording, frames: IntArray, detector: Detector = ORB) -> SceneDepth:
    """The depth of what the camera sees in `frames`.

    Where frames are too far apart for corners to be tracked, local features are matched instead.
    """
    tracked = track_depth(sequence, frames)
    return tracked if math.isfinite(tracked.median_m) else match_depth(sequence, frames, detector)


def track_depth(sequence: Recording, frames: IntArray) -> SceneDepth:
    """The depth of tracked corners; not known from too few submaps."""
    truth = sequence.require_truth()
    depths = []
    for stretch in _stretches(frames, sequence.recording):
        places, quats = truth.positions_xyz[stretch], truth.orientations_quat_wxyz[stretch]
        tracker, corners = CornerTracker(), []
        for i in stretch.tolist():
            tracker.advance(grey_image(sequence.image(i)))
            tracker.mark()
            corners.append(tracker.corners())
        for submap in build_submaps(corners, sequence.camera):
            # scaled to the true positions; not positive if the two disagree
            path = submap.positions @ matrix_from_quat_wxyz(quats[submap.frames[:1]])[0].T
            way = places[submap.frames] - places[submap.frames[0]]
            depths.append(submap.depth * float(np.sum(path * way) / np.sum(path**2)))
    return _robust_depth([depth for depth in depths if depth > 0])


def _robust_depth(depths: list[float]) -> SceneDepth:
    """From some depths in metres; not known from too few."""
    if len(depths) < _MIN_SUBMAPS:
        return UNKNOWN_DEPTH
    logs = np.log(depths)
    middle = float(np.median(logs))
    spread = float(np.median(np.abs(logs - middle))) / MAD_OF_NORMAL
    return SceneDepth(float(np.exp(middle)), max(spread, _MIN_SPREAD))


def match_depth(sequence: Recording, frames: IntArray, detector: Detector) -> SceneDepth:
    """The depth of corners that match between training frames that follow each other."""
    camera, poses = sequence.camera, sequence.require_truth().poses_se3
    following = np.flatnonzero(np.diff(sequence.recording[frames]) == 0)
    pairs = [frames[k : k + 2] for k in following[evenly_spread(len(following), _PAIRS)].tolist()]
    seen = np.unique(pairs).tolist()
    extracted = in_threads(lambda i: extract_local_features(sequence.image(i), camera, detector), seen)
    features, depths = dict(zip(seen, extracted, strict=True)), []
    for pair in pairs:
        here, there = (features[i] for i in pair.tolist())
        [matches] = match(here.descriptors, [there.descriptors])
        if not len(matches):
            continue
        planes = [camera.on_plane(one.pixels[matches[:, j]]) for j, one in enumerate((here, there))]
        corner, side = np.repeat(np.arange(len(matches)), 2), np.tile([0, 1], len(matches))
        R_world_cam, centres = poses[pair, :3, :3], poses[pair, :3, 3]
        rays = Rays(corner, corner, side, np.stack(planes, axis=1).reshape(-1, 2), R_world_cam, centres)
        points = triangulate(rays, _TOLERANCE_PX / camera.fx)
        along = (points.xyz[points.reliable] - centres[0]) @ R_world_cam[0, :, 2]
        if len(along) >= _MIN_POINTS:
            depths.append(float(np.median(along)))
    return _robust_depth(depths)


def _stretches(frames: IntArray, recording: IntArray) -> list[IntArray]:
    """Stretches of neighbouring training frames, each of one recording and without large gaps."""
    gaps = np.diff(frames)
    if gaps.size == 0:
        return []
    apart = (gaps > _GAP * np.median(gaps)) | (np.diff(recording[frames]) != 0)
    pieces = []
    for part in np.split(frames, np.flatnonzero(apart) + 1):
        whole = [part[i : i + _FRAMES] for i in range(0, len(part) - _FRAMES + 1, _FRAMES)]
        pieces += whole or ([part] if len(part) > 2 else [])
    return [pieces[i] for i in evenly_spread(len(pieces), _STRETCHES)]
