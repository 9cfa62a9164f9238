"""Where corners would be without the lens's distortion. Only corners are moved, never whole images."""

from __future__ import annotations

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.poses import PinholeCamera

_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-8)
# In OpenCV 4 the function that takes a criterion has a name of its own; in OpenCV 5 there is one function.
_undistort_points = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


def undistort(pixels: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Pixels (n, 2) of the same rays in the pinhole camera without distortion."""
    if not camera.distortion or not len(pixels):
        return pixels
    matrix, lens = camera.matrix, np.array(camera.distortion)
    ideal = _undistort_points(pixels[:, None], matrix, lens, R=np.eye(3), P=matrix, criteria=_UNTIL)
    return np.asarray(ideal, dtype=np.float64)[:, 0]
