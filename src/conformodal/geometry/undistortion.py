"""Pixels without lens distortion, and intrinsics as PoseLib takes them."""

from __future__ import annotations

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray

from .camera import PinholeCamera

_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-8)
# in OpenCV 4 the function that takes a criterion has its own name; in OpenCV 5 there is one function
_undistort_points = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


def undistort(pixels: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Pixels (n, 2) of the same rays in the pinhole camera without distortion."""
    if not camera.distortion or not len(pixels):
        return pixels
    matrix, lens = camera.matrix, np.array(camera.distortion)
    ideal = _undistort_points(pixels[:, None], matrix, lens, R=np.eye(3), P=matrix, criteria=_UNTIL)
    return np.asarray(ideal, dtype=np.float64)[:, 0]


def poselib_camera(camera: PinholeCamera) -> dict[str, object]:
    """Intrinsics as PoseLib takes them; corners are undistorted before."""
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": params}
