"""Keyframes of a video: sharp frames that differ in view from the one before, however long that takes."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.io.decoding import grey_image
from conformodal.io.diagnosis.flow import corners_of, flow_px, tracked_corners

SIDE_PX = 640  # longer side of the images that are compared
_MIN_CORNERS = 20  # of a frame that shows anything
_EARLIEST = 0.5  # of the motion between keyframes, from which on a sharper frame is taken instead of a later one


class _View(NamedTuple):
    frame: int
    grey: UInt8Array
    corners: Float32Array
    sharpness: float


def reduced(image: UInt8Array) -> UInt8Array:
    """An image (height, width[, 3]) in grey, its longer side at most :data:`SIDE_PX`."""
    grey = grey_image(image)
    scale = SIDE_PX / max(grey.shape)
    if scale >= 1:
        return grey
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def sharpness(grey: UInt8Array) -> float:
    """Variance of the Laplacian (Pech-Pacheco et al. 2000), of images of one scene."""
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


class KeyframePicker:
    """Picks keyframes of frames that come one after the other.

    The next keyframe is the sharpest of those in which corners of the last one have moved by half of `flow_px` to all
    of it. A camera that stands still adds none; one that turns fast adds every frame.
    """

    def __init__(self, flow_px: float) -> None:
        self.flow_px = flow_px
        self.picked: list[int] = []
        self._last: _View | None = None
        self._candidates: list[_View] = []

    def add(self, index: int, image: UInt8Array) -> None:
        """Look at the next frame (height, width, 3), at its place in the video."""
        grey = reduced(image)
        corners = corners_of(grey)
        if corners is None or len(corners) < _MIN_CORNERS:
            return
        view = _View(index, grey, corners, sharpness(grey))
        if self._last is None:
            self._pick(view)
            return
        while (moved := self._moved_px(view)) >= self.flow_px:
            sharpest = max(self._candidates, key=lambda candidate: candidate.sharpness, default=view)
            self._pick(sharpest)
            if sharpest is view:
                return
        if moved >= _EARLIEST * self.flow_px:
            self._candidates.append(view)

    def finish(self) -> list[int]:
        """Places of all keyframes, in order; the last one is near the end of the video."""
        if self._candidates:
            self._pick(self._candidates[-1])
        return self.picked

    def _pick(self, view: _View) -> None:
        self.picked.append(view.frame)
        self._last, self._candidates = view, []

    def _moved_px(self, view: _View) -> float:
        """By how much the corners of the last keyframe have moved; infinite where most are lost."""
        assert self._last is not None
        pixels = tracked_corners(self._last.grey, view.grey, self._last.corners)
        return np.inf if pixels is None else flow_px(pixels)
