"""Five-point solvers: PoseLib's, refined, by default; OpenCV's, as in section 3 of the paper."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import poselib

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.geometry.undistortion import poselib_camera

from .settings import RELATIVE_POSE


class TwoView(NamedTuple):
    """A motion, as in :class:`~conformodal.geometry.RelativeMotion`, and its inliers."""

    R_prev_next: FloatArray
    direction_prev: FloatArray
    inliers: BoolArray  # (n,)


TwoViewSolver: TypeAlias = Callable[[FloatArray, FloatArray, PinholeCamera], TwoView | None]


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
