"""Corners that all lie on a plane: two motions may explain them equally well (Faugeras and Lustman 1988)."""

from __future__ import annotations

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.poses import PinholeCamera

from .settings import RELATIVE_POSE


def plane_motions(
    pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera, tolerance_px: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Motions ``(R_prev_next, direction_prev)`` that explain corners (n, 2) on one plane: one or two, or none.

    Empty if the corners do not lie on a plane within `tolerance_px`. For the convention see
    :class:`~conformodal.poses.RelativeMotion`.
    """
    homography, _ = cv2.findHomography(pixels_prev, pixels_next, 0)
    if homography is None:
        return []
    led = np.column_stack((pixels_prev, np.ones(len(pixels_prev)))) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(led[:, :2] / led[:, 2:] - pixels_next, axis=1)
    if not np.mean(off <= tolerance_px) >= RELATIVE_POSE.plane_share:
        return []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, camera.matrix)
    rays = camera.bearings(pixels_prev)
    found: list[tuple[FloatArray, FloatArray]] = []
    for R_next_prev, t, normal in zip(rotations, translations, normals, strict=True):
        length = float(np.linalg.norm(t))
        if length > 1e-9 and (rays @ normal[:, 0] > RELATIVE_POSE.behind).all():
            R_prev_next = np.asarray(R_next_prev, dtype=np.float64).T
            found.append((R_prev_next, -R_prev_next @ t[:, 0] / length))
    return found
