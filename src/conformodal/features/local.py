"""Local features of an image by name, its global descriptor for retrieval, and how good it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Self, TypeAlias

import cv2
import numpy as np

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import thumbnail
from conformodal.io.decoding import grey_image

DESCRIPTOR_BYTES = 32
MAX_CORNERS = 500
_LEVELS = 4  # of the pyramid; with more, corners come from coarse levels and poses get worse
_BLUR_PX = 1.2  # before detection: pixel noise of a sigma of 0.2 then leaves descriptors nearly unchanged
_LEAST_WIDTH_PX = 320  # smaller images are enlarged: descriptors look at 31 pixels around a corner
_RATIO = 0.85  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)
_MOST_ALIKE = 8 * DESCRIPTOR_BYTES / 4  # product of equal rows, see _halves

QUALITIES = ("brightness", "contrast", "detail")
NOT_MEASURED: FloatArray = np.full(len(QUALITIES), np.nan)
_MARGIN = 0.1  # of the range of each quality, at each end
_DETAIL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)


class LocalFeatures(NamedTuple):
    """Corners of an image with their descriptors, and its global descriptor."""

    pixels: FloatArray  # (n, 2) undistorted corners
    descriptors: UInt8Array  # (n, 32)
    global_descriptor: Float32Array  # at unit length: thumbnail or network's map
    quality: FloatArray = NOT_MEASURED  # (3,), see image_quality
    flow: FloatArray = NO_FLOW  # (2, 3), see conformodal.tracking.tracker.affine_flow

    @property
    def flows(self) -> FloatArray:
        """Flow (n, 2) of each corner, pixels per second."""
        return np.asarray(self.pixels @ self.flow[:, :2].T + self.flow[:, 2])

    def at_pose_time(self, shutter: FloatArray, camera: PinholeCamera) -> LocalFeatures:
        """With corners where they are when the pose is taken, see :meth:`PinholeCamera.at_pose_time`."""
        return self._replace(pixels=camera.at_pose_time(self.pixels, self.flows, shutter))


class Corners(NamedTuple):
    """What a detector finds in an image."""

    pixels: FloatArray  # (n, 2)
    descriptors: UInt8Array  # (n, 32)


# from a grey image (height, width)
Detector: TypeAlias = Callable[[UInt8Array], Corners]


def detect_orb(grey: UInt8Array) -> Corners:
    """ORB (Rublee et al. 2011), in small images enlarged."""
    enlarged = -(-_LEAST_WIDTH_PX // grey.shape[1])
    if enlarged > 1:
        grey = np.asarray(cv2.resize(grey, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_LINEAR), np.uint8)
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), np.uint8)
    corners, descriptors = cv2.ORB.create(
        MAX_CORNERS, 1.2, _LEVELS, edgeThreshold=16, fastThreshold=5
    ).detectAndCompute(grey, None)
    if descriptors is None:
        return Corners(np.empty((0, 2)), np.empty((0, DESCRIPTOR_BYTES), np.uint8))
    # pixel centres are whole numbers, so that enlarging moves them by half a pixel
    pixels = (np.array([corner.pt for corner in corners]) + 0.5) / enlarged - 0.5
    return Corners(pixels, np.asarray(descriptors, np.uint8))


DETECTORS: dict[str, Detector] = {"orb": detect_orb}


def extract_local_features(image: UInt8Array, camera: PinholeCamera, detector: str = "orb") -> LocalFeatures:
    """Local features, of one of :data:`DETECTORS`, and global descriptor of an image (height, width[, 3])."""
    grey = grey_image(image)
    corners = DETECTORS[detector](grey)
    return LocalFeatures(camera.undistort(corners.pixels), corners.descriptors, thumbnail(grey), image_quality(grey))


def match(descriptors: UInt8Array, others: UInt8Array) -> IntArray:
    """Mutually unambiguous matches (m, 2) between rows of two sets of descriptors, by Lowe's ratio test."""
    if len(descriptors) == 0 or len(others) < 2:
        return np.empty((0, 2), np.int64)
    alike = _halves(descriptors) @ _halves(others).T
    every = np.arange(len(alike))
    nearest = alike.argmax(axis=1)
    first = alike[every, nearest]
    alike[every, nearest] = -np.inf
    distance, second = _MOST_ALIKE - first, _MOST_ALIKE - alike.max(axis=1)
    rows = np.flatnonzero(distance < _RATIO * second)
    rows = rows[np.argsort(distance[rows], kind="stable")]
    _, best = np.unique(nearest[rows], return_index=True)
    rows = rows[best]
    return np.column_stack((rows, nearest[rows])).astype(np.int64)


class Matcher:
    """Matches between pairs of images, cached: the maps of several folds share images."""

    def __init__(self) -> None:
        self._cached: dict[tuple[int, int], tuple[LocalFeatures, LocalFeatures, IntArray]] = {}

    def __call__(self, one: LocalFeatures, other: LocalFeatures) -> IntArray:
        """Matches (m, 2) of the descriptors of two images, see :func:`match`."""
        key = id(one), id(other)  # unique, since the cache holds both images
        if key not in self._cached:
            self._cached[key] = one, other, match(one.descriptors, other.descriptors)
        return self._cached[key][2]


def _halves(descriptors: UInt8Array) -> Float32Array:
    """Bits as -0.5 and 0.5: a matrix product of such rows counts differing bits faster than a loop."""
    return np.unpackbits(descriptors, axis=1).astype(np.float32) - np.float32(0.5)


def image_quality(grey: UInt8Array) -> FloatArray:
    """(3,) :data:`QUALITIES` of a grey image (height, width), in grey levels.

    Mean and standard deviation; and the mean response to a mask that edges do not pass (Immerkaer 1996): much of it is
    noise, little of it is blur.
    """
    mean, spread = cv2.meanStdDev(grey)
    detail = np.abs(cv2.filter2D(grey, cv2.CV_32F, _DETAIL)).mean()
    return np.array([mean[0, 0], spread[0, 0], detail], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class QualityRange:
    """The least and the largest of each quality, (3,), that known images have, or nearly."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, qualities: FloatArray) -> Self:
        """Of images with these qualities (n, 3), widened a little, so that images like them are rarely beyond."""
        low, high = qualities.min(axis=0), qualities.max(axis=0)
        return cls(low - _MARGIN * (high - low), high + _MARGIN * (high - low))

    def left_by(self, qualities: FloatArray) -> BoolArray:
        """(n,) whether a quality (n, 3) is out of range; False where it was not measured."""
        return np.asarray(((qualities < self.low) | (qualities > self.high)).any(axis=1))
