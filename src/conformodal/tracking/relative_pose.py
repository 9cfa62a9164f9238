"""Rotation and unit direction between two frames from corner pairs (the paper, section 3), or why there are none.

Standard deviations follow from the residuals and the parallax of the inliers. Errors of neighbouring corners are
correlated: they share texture, blur, shutter and depth. So all corners of an image cell share one error, which least
squares passes on to the motion (the sandwich covariance of clustered data, Liang and Zeger 1986), times a factor
measured in ``benchmarks/relative_motion.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import MotionStatus, PinholeCamera, RelativeMotion, cross_matrices
from conformodal.geometry.robust import MAD_OF_NORMAL, MEDIAN_OF_NORM2

from .settings import MOTION_ERRORS, RELATIVE_POSE
from .two_view import CameraMotion, TwoViewSolver, invert_pose, solve_poselib


def estimate_relative_motion(
    pixels_prev: FloatArray,
    pixels_next: FloatArray,
    camera: PinholeCamera,
    n_at_start: int | None = None,
    solver: TwoViewSolver = solve_poselib,
) -> RelativeMotion:
    """Motion of the camera between two frames; a rotation where it is sound, a direction only with enough parallax.

    From the pixels (n, 2) of the same corners, as they are in the images. `n_at_start` counts the corners in the
    previous frame before tracking, which tells a blank frame from a cut.
    """
    n = len(pixels_prev)
    if n < RELATIVE_POSE.min_tracks:
        blank = (n_at_start if n_at_start is not None else n) < RELATIVE_POSE.min_tracks
        return RelativeMotion(MotionStatus.TOO_FEW if blank else MotionStatus.LOST, n_tracks=n)
    pixels_prev, pixels_next = camera.undistort(pixels_prev), camera.undistort(pixels_next)
    pixel = 2.0 / (camera.fx + camera.fy)  # radians
    flow = np.linalg.norm(pixels_next - pixels_prev, axis=1)
    if np.median(flow) < RELATIVE_POSE.repeated_flow_px:
        return RelativeMotion(
            MotionStatus.REPEATED,
            np.eye(3),
            n_tracks=n,
            n_inliers=n,
            rotation_sigma_rad=RELATIVE_POSE.repeated_flow_px * pixel,
        )

    pairs = _Pairs(pixels_prev, pixels_next, camera.bearings(pixels_prev), camera.bearings(pixels_next))
    cells = image_cells(pixels_prev, camera)
    return _pure_rotation(pairs, cells, pixel) or _two_view_motion(pairs, cells, pixel, camera, solver)


class _Pairs(NamedTuple):
    """The same corners in two frames: pixels (n, 2) without distortion, and unit rays (n, 3)."""

    pixels_prev: FloatArray
    pixels_next: FloatArray
    rays_prev: FloatArray
    rays_next: FloatArray

    def take(self, rows: BoolArray) -> _Pairs:
        return _Pairs(*(part[rows] for part in self))

    def parallax(self, R_prev_next: FloatArray) -> float:
        """Median angle by which corners moved beyond what a rotation explains."""
        return float(np.median(_angles(self.rays_prev, self.rays_next @ R_prev_next.T)))


def _pure_rotation(pairs: _Pairs, cells: IntArray, pixel: float) -> RelativeMotion | None:
    """The motion if a rotation alone explains the pair, which leaves the direction undetermined; or None."""
    rotation, inliers = _fit_rotation(pairs, RELATIVE_POSE.min_parallax_px * pixel)
    if inliers.mean() < RELATIVE_POSE.turning_share:
        return None
    used = pairs.take(inliers)
    return RelativeMotion(
        MotionStatus.LOW_PARALLAX,
        rotation,
        None,
        len(inliers),
        int(inliers.sum()),
        parallax_rad=pairs.parallax(rotation),
        rotation_sigma_rad=turning_spread(used.rays_prev, used.rays_next, rotation, cells[inliers], pixel),
    )


def _two_view_motion(
    pairs: _Pairs, cells: IntArray, pixel: float, camera: PinholeCamera, solver: TwoViewSolver
) -> RelativeMotion:
    n, view = len(cells), solver(pairs.pixels_prev, pairs.pixels_next, camera)
    n_inliers = 0 if view is None else int(view.inliers.sum())
    if view is None or n_inliers < max(RELATIVE_POSE.min_tracks, RELATIVE_POSE.min_inlier_share * n):
        return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n, n_inliers=n_inliers)
    R_prev_next, direction, inliers = view
    used = pairs.take(inliers)
    parallax = used.parallax(R_prev_next)
    spread = motion_spreads(used.rays_prev, used.rays_next, R_prev_next, direction, cells[inliers], pixel)
    status, rotation_sigma = MotionStatus.OK, spread.rotation
    if parallax < RELATIVE_POSE.min_parallax_px * pixel:
        status = MotionStatus.LOW_PARALLAX
    else:
        ways = plane_motions(used.pixels_prev, used.pixels_next, camera, RELATIVE_POSE.epipolar_px)
        directions = np.array([way.direction_prev for way in ways[:2]])
        if len(ways) > 1 and _angles(directions[:1], directions[1:])[0] > RELATIVE_POSE.plane_ambiguity_rad:
            # the rotation is one of two as well: as uncertain as they differ
            apart = Rotation.from_matrix(ways[0].R_prev_next.T @ ways[1].R_prev_next).magnitude()
            status, rotation_sigma = MotionStatus.PLANE, float(np.hypot(rotation_sigma, apart))
    ok = status is MotionStatus.OK
    return RelativeMotion(
        status,
        R_prev_next,
        direction if ok else None,
        n,
        n_inliers,
        parallax,
        rotation_sigma,
        spread.direction if ok else np.inf,
    )


def plane_motions(
    pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera, tolerance_px: float
) -> list[CameraMotion]:
    """Motions that explain corners (n, 2) on one plane: one or two, or none.

    Faugeras and Lustman (1988). Empty if the corners do not lie on a plane within `tolerance_px`.
    """
    homography, _ = cv2.findHomography(pixels_prev, pixels_next, 0)
    if homography is None:
        return []
    mapped = np.column_stack((pixels_prev, np.ones(len(pixels_prev)))) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - pixels_next, axis=1)
    if not np.mean(off <= tolerance_px) >= RELATIVE_POSE.plane_share:
        return []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, camera.matrix)
    rays = camera.bearings(pixels_prev)
    motions = [
        invert_pose(R_next_prev, t)
        for R_next_prev, t, normal in zip(rotations, translations, normals, strict=True)
        if (rays @ normal[:, 0] > RELATIVE_POSE.behind).all()
    ]
    return [motion for motion in motions if motion is not None]


def _fit_rotation(pairs: _Pairs, tolerance_rad: float) -> tuple[FloatArray, BoolArray]:
    """Rotation with ``rays_prev = R rays_next`` on most rays, and these: trimmed least squares, from all of them."""
    keep = np.ones(len(pairs.rays_prev), dtype=bool)
    matrix = np.eye(3)
    for _ in range(RELATIVE_POSE.rotation_rounds):
        rotation, _ = Rotation.align_vectors(pairs.rays_prev[keep], pairs.rays_next[keep])
        matrix = np.asarray(rotation.as_matrix())
        error = _angles(pairs.rays_prev, pairs.rays_next @ matrix.T)
        keep = error <= max(tolerance_rad, 2.0 * float(np.median(error)))
    return matrix, error <= tolerance_rad


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between unit vectors (n, 3), in radians; exact for small ones."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


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
