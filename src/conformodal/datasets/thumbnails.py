"""A small blurry picture of an image: where things are as a whole, to find images that look alike."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

THUMBNAIL = (32, 24)
_BEFORE_BLUR = 128  # pixels across


def thumbnail(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """The picture (768,) of an image (height, width[, 3]), RGB or grey: of zero mean and unit length.

    Zero for an image without contrast.
    """
    height, width = image.shape[:2]
    before = (_BEFORE_BLUR, max(1, round(height * _BEFORE_BLUR / width)))
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.GaussianBlur(cv2.resize(grey, before, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    picture = cv2.resize(small, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    picture -= picture.mean()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-6), dtype=np.float32)
