"""Five-point solvers: PoseLib's, refined, by default; OpenCV's, as in section 3 of the paper."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import poselib

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.poses import PinholeCamera

from .settings import RELATIVE_POSE


class TwoView(NamedTuple):
    """A motion, as in :class:`~conformodal.poses.RelativeMotion`, and its inliers."""

    R_prev_next: FloatArray
    direction_prev: FloatArray
    inliers: BoolArray  # (n,)


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


TwoViewSolver: TypeAlias = Callable[[FloatArray, FloatArray, PinholeCamera], TwoView | None]


def poselib_camera(camera: PinholeCamera) -> dict[str, object]:
    """Intrinsics as PoseLib takes them; corners are undistorted before."""
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": params}


def solve_poselib(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """LO-RANSAC over five points, then a robust fit to all inliers, of undistorted pixels (n, 2).

    PoseLib maps points as ``X_next = R X_prev + t``; the result is inverted, to the camera's own motion.
    """
    model = poselib_camera(camera)
    pose, info = poselib.estimate_relative_pose(
        pixels_prev, pixels_next, model, model, RELATIVE_POSE.ransac, RELATIVE_POSE.refinement
    )
    return _turned_round(np.asarray(pose.R), np.asarray(pose.t), np.asarray(info["inliers"], dtype=np.bool_))


def solve_opencv(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """OpenCV's ``findEssentialMat`` with RANSAC and ``recoverPose``; parameters as for :func:`solve_poselib`."""
    intrinsics = camera.matrix
    cv2.setRNGSeed(0)
    found, mask = cv2.findEssentialMat(
        pixels_prev, pixels_next, intrinsics, cv2.RANSAC, 0.999, RELATIVE_POSE.epipolar_px, 1000
    )
    if found is None or mask is None:
        return None
    inliers = mask.ravel() > 0
    best: tuple[int, FloatArray, FloatArray] | None = None
    for E in np.asarray(found).reshape(-1, 3, 3):  # five points may leave several matrices, one below the other
        n, R, t, *_ = cv2.recoverPose(
            E, pixels_prev[inliers], pixels_next[inliers], intrinsics, distanceThresh=RELATIVE_POSE.farthest
        )
        if best is None or n > best[0]:
            best = int(n), np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    return None if best is None else _turned_round(best[1], best[2].ravel(), inliers)


def _turned_round(R_next_prev: FloatArray, t: FloatArray, inliers: BoolArray) -> TwoView | None:
    direction = -R_next_prev.T @ t
    length = float(np.linalg.norm(direction))
    if not np.isfinite(length) or length < 1e-9:
        return None
    return TwoView(R_next_prev.T, direction / length, inliers)
