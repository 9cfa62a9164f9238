"""Corners of one image that are found in another."""

from __future__ import annotations

import cv2
import numpy as np

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, UInt8Array

_CORNERS = 300
MIN_TRACKED = 0.5  # of the corners: where frames are so far apart that most are lost, many of the others are wrong


def corners_of(grey: UInt8Array) -> Float32Array | None:
    """Corners (k, 1, 2) of an image (h, w), if it has any."""
    corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
    return None if corners is None else np.asarray(corners, dtype=np.float32)


def tracked_corners(grey: UInt8Array, other: UInt8Array, corners: Float32Array | None = None) -> FloatArray | None:
    """Corners (m, 2, 2) of an image in both, if most of them are found and back again; `corners` are those known."""
    corners = corners_of(grey) if corners is None else corners
    if corners is None:
        return None
    tracked, found = track(grey, other, corners)
    if found.mean() < MIN_TRACKED:
        return None
    return np.stack((corners[found, 0], tracked[found, 0]), axis=1).astype(np.float64)


def track(grey: UInt8Array, other: UInt8Array, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Where corners (k, 1, 2) of an image are in another, (k, 1, 2), and which of them (k,) are found back again."""
    tracked, there, _ = cv2.calcOpticalFlowPyrLK(grey, other, corners, None)  # type: ignore[call-overload]
    again, back, _ = cv2.calcOpticalFlowPyrLK(other, grey, tracked, None)  # type: ignore[call-overload]
    found = (there & back).ravel().astype(bool) & (np.linalg.norm(again - corners, axis=2).ravel() < 1)
    return np.asarray(tracked, dtype=np.float32), np.asarray(found)


def flow_px(pixels: FloatArray) -> float:
    """By how much corners (m, 2, 2) usually move."""
    return float(np.median(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)))
