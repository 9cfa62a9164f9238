"""The depth of the scene, learnt from training frames; it gives submaps their scale."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import IntArray, evenly_spread
from conformodal.geometry import Submap, Trajectory, matrix_from_quat_wxyz
from conformodal.geometry.adjustment import MAD_OF_NORMAL
from conformodal.io import Recording
from conformodal.io.decoding import grey_image
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import Corners, CornerTracker

_STRETCHES, _FRAMES = 10, 12  # stretches, spread over all training frames, and frames of each
_GAP = 4.0  # a stretch ends at a gap longer than the median one by this factor
_LEAST_SUBMAPS = 5  # with fewer, the depth is not known
_LEAST_SPREAD = 0.1  # standard deviation of the logarithm of the depth


def measure_depths(sequence: Recording, frames: IntArray) -> tuple[float, float]:
    """Median depth of corners in metres, and spread of its logarithm, from `frames`; NaN from too few submaps."""
    truth = sequence.require_truth()
    depths = []
    for stretch in _stretches(frames, sequence.recording):
        submaps = build_submaps(_followed(sequence, stretch), sequence.camera)
        depths += [depth for s in submaps if (depth := _depth(s, truth[stretch])) > 0]
    if len(depths) < _LEAST_SUBMAPS:
        return float("nan"), float("nan")
    logs = np.log(depths)
    middle = float(np.median(logs))
    spread = float(np.median(np.abs(logs - middle))) / MAD_OF_NORMAL
    return float(np.exp(middle)), max(spread, _LEAST_SPREAD)


def _stretches(frames: IntArray, recording: IntArray) -> list[IntArray]:
    """Stretches of neighbouring training frames, each of one recording and without large gaps."""
    gaps = np.diff(frames)
    if gaps.size == 0:
        return []
    apart = (gaps > _GAP * np.median(gaps)) | (np.diff(recording[frames]) != 0)
    pieces = [p for part in np.split(frames, np.flatnonzero(apart) + 1) for p in _cut(part)]
    return [pieces[i] for i in evenly_spread(len(pieces), _STRETCHES)]


def _cut(part: IntArray) -> list[IntArray]:
    n = _FRAMES
    return [part[i * n : (i + 1) * n] for i in range(len(part) // n)] or ([part] if len(part) > 2 else [])


def _followed(sequence: Recording, frames: IntArray) -> list[Corners]:
    tracker, corners = CornerTracker(), []
    for i in frames.tolist():
        tracker.advance(grey_image(sequence.image(i)))
        tracker.mark()
        corners.append(tracker.corners())
    return corners


def _depth(submap: Submap, truth: Trajectory) -> float:
    """Median depth in metres of a submap scaled to the true positions; not positive if the two disagree."""
    places = truth.positions_xyz[submap.frames]
    path = submap.positions @ matrix_from_quat_wxyz(truth.orientations_quat_wxyz[submap.frames[:1]])[0].T
    return submap.depth * float(np.sum(path * (places - places[0])) / np.sum(path**2))
