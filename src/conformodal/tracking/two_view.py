"""Five-point solvers: PoseLib's, refined, by default; OpenCV's, as in section 3 of the paper."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import poselib

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray
from conformodal.geometry import PinholeCamera

from .settings import RELATIVE_POSE


class CameraMotion(NamedTuple):
    """A motion, as in :class:`~conformodal.geometry.RelativeMotion`."""

    R_prev_next: FloatArray
    direction_prev: FloatArray


class TwoView(NamedTuple):
    """A motion and its inliers."""

    R_prev_next: FloatArray
    direction_prev: FloatArray
    inliers: BoolArray  # (n,)


TwoViewSolver: TypeAlias = Callable[[FloatArray, FloatArray, PinholeCamera], TwoView | None]


def solve_poselib(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """LO-RANSAC over five points, then a robust fit to all inliers, of undistorted pixels (n, 2)."""
    model = camera.poselib()
    pose, info = poselib.estimate_relative_pose(
        pixels_prev, pixels_next, model, model, RELATIVE_POSE.ransac, RELATIVE_POSE.refinement
    )
    motion = invert_pose(pose.R, pose.t)
    return None if motion is None else TwoView(*motion, np.asarray(info["inliers"], dtype=np.bool_))


def solve_opencv(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """OpenCV's ``findEssentialMat`` with RANSAC and ``recoverPose``; parameters as for :func:`solve_poselib`."""
    intrinsics = camera.matrix
    cv2.setRNGSeed(0)
    matrices, mask = cv2.findEssentialMat(
        pixels_prev, pixels_next, intrinsics, cv2.RANSAC, 0.999, RELATIVE_POSE.epipolar_px, 1000
    )
    if matrices is None or mask is None:
        return None
    inliers = mask.ravel() > 0
    pairs = pixels_prev[inliers], pixels_next[inliers]
    candidates = [  # five points may leave several matrices, one below the other
        cv2.recoverPose(E, *pairs, intrinsics, distanceThresh=RELATIVE_POSE.farthest)
        for E in np.asarray(matrices).reshape(-1, 3, 3)
    ]
    _, R, t, *_ = max(candidates, key=lambda candidate: int(candidate[0]))  # corners in front of both cameras
    motion = invert_pose(R, t)
    return None if motion is None else TwoView(*motion, inliers)


def invert_pose(R_next_prev: AnyArray, t: AnyArray) -> CameraMotion | None:
    """The camera's own motion, from how points move: ``X_next = R X_prev + t``; None if it does not move."""
    R_prev_next = np.asarray(R_next_prev, dtype=np.float64).T
    direction = -R_prev_next @ np.asarray(t, dtype=np.float64).ravel()
    length = float(np.linalg.norm(direction))
    if not np.isfinite(length) or length < 1e-9:
        return None
    return CameraMotion(R_prev_next, direction / length)
