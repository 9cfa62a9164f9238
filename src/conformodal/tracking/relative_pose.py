"""Rotation and unit direction between two frames from corner pairs (the paper, section 3), or why there are none."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import MotionStatus, PinholeCamera, RelativeMotion
from conformodal.geometry.undistortion import undistort

from .settings import RELATIVE_POSE
from .spreads import image_cells, motion_spreads, turning_spread
from .two_view import TwoViewSolver, solve_poselib


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
    pixels_prev, pixels_next = undistort(pixels_prev, camera), undistort(pixels_next, camera)
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

    rays = camera.bearings(pixels_prev), camera.bearings(pixels_next)
    turning = _turning_alone(*rays, image_cells(pixels_prev, camera), pixel)
    return turning or _moving(pixels_prev, pixels_next, *rays, camera, solver)


def _turning_alone(
    rays_prev: FloatArray, rays_next: FloatArray, cells: IntArray, pixel: float
) -> RelativeMotion | None:
    """The motion if a rotation alone explains the pair, which leaves the direction undetermined; or None."""
    rotation, inliers = _rotation_only(rays_prev, rays_next, RELATIVE_POSE.min_parallax_px * pixel)
    if inliers.mean() < RELATIVE_POSE.turning_share:
        return None
    return RelativeMotion(
        MotionStatus.LOW_PARALLAX,
        rotation,
        None,
        len(rays_prev),
        int(inliers.sum()),
        parallax_rad=float(np.median(_angles(rays_prev, rays_next @ rotation.T))),
        rotation_sigma_rad=turning_spread(rays_prev[inliers], rays_next[inliers], rotation, cells[inliers], pixel),
    )


def _moving(
    pixels_prev: FloatArray,
    pixels_next: FloatArray,
    rays_prev: FloatArray,
    rays_next: FloatArray,
    camera: PinholeCamera,
    solver: TwoViewSolver,
) -> RelativeMotion:
    """The motion by two-view geometry, of pixels without distortion."""
    n, pixel, found = len(pixels_prev), 2.0 / (camera.fx + camera.fy), solver(pixels_prev, pixels_next, camera)
    least, share = RELATIVE_POSE.min_tracks, RELATIVE_POSE.min_inlier_share
    if found is None or found.inliers.sum() < least or found.inliers.mean() < share:
        n_inliers = 0 if found is None else int(found.inliers.sum())
        return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n, n_inliers=n_inliers)
    R_prev_next, direction, inliers = found
    parallax = float(np.median(_angles(rays_prev[inliers], rays_next[inliers] @ R_prev_next.T)))
    enough = parallax >= RELATIVE_POSE.min_parallax_px * pixel
    status = MotionStatus.OK if enough else MotionStatus.LOW_PARALLAX
    cells = image_cells(pixels_prev[inliers], camera)
    rotation_sigma, direction_sigma = motion_spreads(
        rays_prev[inliers], rays_next[inliers], R_prev_next, direction, cells, pixel
    )
    if enough:
        ways = plane_motions(pixels_prev[inliers], pixels_next[inliers], camera, RELATIVE_POSE.epipolar_px)
        if len(ways) > 1 and _angles(ways[0][1][None], ways[1][1][None])[0] > RELATIVE_POSE.plane_ambiguity_rad:
            # the rotation is one of two as well: as uncertain as they differ
            apart = Rotation.from_matrix(ways[0][0].T @ ways[1][0]).magnitude()
            status, enough, rotation_sigma = MotionStatus.PLANE, False, float(np.hypot(rotation_sigma, apart))
    return RelativeMotion(
        status,
        R_prev_next,
        direction if enough else None,
        n,
        int(inliers.sum()),
        parallax,
        rotation_sigma,
        direction_sigma if enough else np.inf,
    )


def plane_motions(
    pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera, tolerance_px: float
) -> list[tuple[FloatArray, FloatArray]]:
    """Motions ``(R_prev_next, direction_prev)`` that explain corners (n, 2) on one plane: one or two, or none.

    Faugeras and Lustman (1988). Empty if the corners do not lie on a plane within `tolerance_px`.
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


def _rotation_only(rays_prev: FloatArray, rays_next: FloatArray, tolerance_rad: float) -> tuple[FloatArray, BoolArray]:
    """Rotation with ``rays_prev = R rays_next`` on most rays: trimmed least squares, started from all of them."""
    keep = np.ones(len(rays_prev), dtype=bool)
    matrix = np.eye(3)
    for _ in range(5):
        rotation, _ = Rotation.align_vectors(rays_prev[keep], rays_next[keep])
        matrix = np.asarray(rotation.as_matrix())
        error = _angles(rays_prev, rays_next @ matrix.T)
        keep = error <= max(tolerance_rad, 2.0 * float(np.median(error)))
    return matrix, error <= tolerance_rad


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between unit vectors (n, 3), in radians; exact for small ones."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))
