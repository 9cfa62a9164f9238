"""How fast the picture moves where a frame is taken: an affine model of the flow of tracked corners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, UInt8Array
from conformodal.features.local import LocalFeatures, extract_local_features
from conformodal.geometry import PinholeCamera
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import ImageError, Recording
from conformodal.io.decoding import grey_image

from .tracker import CornerTracker

_LONGEST_S = 0.2  # between frames: what moved before says little about now
_LEAST_CORNERS = 16
_ITERATIONS = 6
_LEAST_PX = 0.1  # scale of the residuals, at least

_Step = tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]


def affine_flow(step: _Step, seconds: float, camera: PinholeCamera) -> FloatArray:
    """Flow (2, 3) in pixels per second, as ``flow @ (x, y, 1)`` at an undistorted pixel, by robust least squares.

    `step` are pixels (n, 2) of the same corners `seconds` ago and now, see :attr:`CornerTracker.step`: those of the
    usable frame directly before, in training as in a run. Zero, if they are few or that is long ago.
    """
    if not 0 < seconds < _LONGEST_S or len(step[0]) < _LEAST_CORNERS:
        return NO_FLOW
    before, now = (camera.undistort(pixels.astype(np.float64)) for pixels in step)
    shifts, rows = now - before, np.column_stack((now, np.ones(len(now))))
    weights = np.ones((len(now), 1))
    for _ in range(_ITERATIONS):
        flow, *_ = np.linalg.lstsq(rows * weights, shifts * weights, rcond=None)
        off = np.linalg.norm(shifts - rows @ flow, axis=1)
        weights = 1 / np.sqrt(1 + (off / (np.median(off) + _LEAST_PX)) ** 2)[:, None]
    return np.asarray(flow.T / seconds)


def flow_of(sequence: Recording, i: int, image: UInt8Array) -> FloatArray:
    """The flow (2, 3) in a frame of a sequence, its `image`, from the last frame before it that can be read."""
    for before in range(i - 1, -1, -1):
        seconds = float(sequence.timestamps_s[i] - sequence.timestamps_s[before])
        if not 0 < seconds < _LONGEST_S or sequence.recording[i] != sequence.recording[before]:
            break
        tracker = CornerTracker()
        try:
            tracker.advance(grey_image(sequence.image(before)))
        except ImageError:
            continue
        tracker.mark()
        tracker.advance(grey_image(image))
        return affine_flow(tracker.step, seconds, sequence.camera)
    return NO_FLOW


def frame_features(sequence: Recording, i: int) -> LocalFeatures:
    """Local features of a frame of a sequence, with its flow."""
    image = sequence.image(i)
    return extract_local_features(image, sequence.camera)._replace(flow=flow_of(sequence, i, image))
