"""How good an image is, measured in the image itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, UInt8Array

QUALITIES = ("brightness", "contrast", "detail")
NOT_MEASURED: FloatArray = np.full(len(QUALITIES), np.nan)

_MARGIN = 0.1  # of the range, at each end
_DETAIL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)


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
