"""Standard deviations of a relative motion, from the residuals and the parallax of its inliers.

Errors of neighbouring corners are correlated: they share texture, blur, shutter and depth. So all corners of an image
cell share one error, which least squares passes on to the motion (the sandwich covariance of clustered data, Liang and
Zeger 1986), times a factor measured in ``benchmarks/relative_motion.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import PinholeCamera, cross_matrices
from conformodal.geometry.robust import MAD_OF_NORMAL, MEDIAN_OF_NORM2

from .settings import MOTION_ERRORS


def image_cells(pixels: FloatArray, camera: PinholeCamera) -> IntArray:
    """Cell (n,) of every pixel (n, 2) in a grid of 4 x 3 over the image."""
    column = np.clip(pixels[:, 0] * MOTION_ERRORS.columns // camera.width, 0, MOTION_ERRORS.columns - 1)
    row = np.clip(pixels[:, 1] * MOTION_ERRORS.rows // camera.height, 0, MOTION_ERRORS.rows - 1)
    return (column * MOTION_ERRORS.rows + row).astype(np.int64)


class MotionSpread(NamedTuple):
    """Standard deviations (radians) of a rotation about each axis, and of a direction along each orthogonal axis."""

    rotation: float
    direction: float


def motion_spreads(
    rays_prev: FloatArray,
    rays_next: FloatArray,
    R_prev_next: FloatArray,
    direction_prev: FloatArray,
    cells: IntArray,
    pixel_rad: float,
) -> MotionSpread:
    """From unit rays (n, 3) of the inliers and their cells (n,) from :func:`image_cells`; ``inf`` if undetermined."""
    turned = rays_next @ R_prev_next.T
    normal, other = np.cross(direction_prev, turned), np.cross(direction_prev, rays_prev)
    size = np.sqrt((normal**2).sum(axis=1) + (other**2).sum(axis=1))
    # angle off the epipolar plane, and how it changes with a turn of the next camera and of the direction
    residual = (rays_prev * normal).sum(axis=1) / size
    sideways = np.linalg.svd(direction_prev[None])[2][1:].T
    by_turn = np.cross(rays_next, -other @ R_prev_next)
    by_direction = np.cross(turned, rays_prev) @ sideways
    jacobian = np.concatenate((by_turn, by_direction), axis=1) / size[:, None]
    sigma = max(float(np.median(np.abs(residual))) / MAD_OF_NORMAL, MOTION_ERRORS.least_residual_px * pixel_rad)
    covariance = _clustered(jacobian[:, None], cells, sigma)
    rotation, direction = np.trace(covariance[:3, :3]) / 3, np.trace(covariance[3:, 3:]) / 2
    return MotionSpread(
        MOTION_ERRORS.rotation_factor * float(np.sqrt(rotation)),
        MOTION_ERRORS.direction_factor * float(np.sqrt(direction)),
    )


def turning_spread(
    rays_prev: FloatArray, rays_next: FloatArray, R_prev_next: FloatArray, cells: IntArray, pixel_rad: float
) -> float:
    """Standard deviation of a pure rotation about each axis, as :func:`motion_spreads`."""
    turned = rays_next @ R_prev_next.T
    off = np.linalg.norm(rays_prev - turned, axis=1)
    jacobian = -cross_matrices(turned)  # a turn w in the previous frame moves a ray by w x ray
    size = max(float(np.median(off)) / MEDIAN_OF_NORM2, MOTION_ERRORS.least_residual_px * pixel_rad)
    return MOTION_ERRORS.rotation_factor * float(np.sqrt(np.trace(_clustered(jacobian, cells, size)) / 3))


def _clustered(jacobian: FloatArray, cells: IntArray, sigma: float) -> FloatArray:
    """Covariance of least squares with rows `jacobian` (n, m, p), if each cell has one error of spread `sigma`."""
    p = jacobian.shape[2]
    information = np.einsum("nmi,nmj->ij", jacobian, jacobian)
    if not np.linalg.cond(information) < 1e12:
        return np.full((p, p), np.inf)
    pulls = np.zeros((MOTION_ERRORS.columns * MOTION_ERRORS.rows, *jacobian.shape[1:]))
    np.add.at(pulls, cells, jacobian)
    inverse = np.linalg.inv(information)
    return np.asarray(sigma**2 * inverse @ np.einsum("cmi,cmj->ij", pulls, pulls) @ inverse)
