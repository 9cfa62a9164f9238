"""Rotation and unit direction between two frames from corner pairs (the paper, section 3), or why there are none.

The five-point solver is PoseLib's, refined; the paper's system has OpenCV's. Standard deviations follow from the
residuals and the parallax of the inliers. Errors of neighbouring corners are correlated: they share texture, blur,
shutter and depth. So all corners of an image cell share one error, which least squares passes on to the motion (the
sandwich covariance of clustered data, Liang and Zeger 1986), times a factor measured in
``benchmarks/relative_motion.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import poselib

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from conformodal.geometry import MotionStatus, PinholeCamera, RelativeMotion, cross_matrices
from conformodal.geometry.adjustment import MAD_OF_NORMAL, MEDIAN_OF_NORM2
from conformodal.geometry.poses import trusted_rotation

MIN_TRACKS = 16  # tracked corners
_MIN_INLIER_SHARE = 0.5
_REPEATED_FLOW_PX = 0.05  # median displacement below which the picture is repeated or the camera at rest
_PLANE_AMBIGUITY_RAD = float(np.radians(5.0))  # between the two directions that a plane allows
_ROTATION_ROUNDS = 5  # of the trimmed fit of a rotation
_TURNING_SHARE = 0.9  # of the corners that a rotation alone must explain to be the answer
_MIN_PARALLAX_PX = 1.0  # below this, parallax is lost in tracking errors
_PLANE_SHARE = 0.97  # of the corners that one plane must explain
_BEHIND = -1e-3  # plane distances by which tracking errors may put a corner behind a camera
_EPIPOLAR_PX = 1.0  # largest distance from an epipolar line
_RANSAC = {"max_epipolar_error": _EPIPOLAR_PX, "max_iterations": 1000, "min_iterations": 20, "seed": 0}
# corners drift by a few tenths of a pixel: the final fit gives those beyond a quarter less weight
_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 0.25, "max_iterations": 20}
_FARTHEST = 1e4  # steps beyond which OpenCV does not count a point as in front of both cameras
_COLUMNS, _ROWS = 4, 3  # parts of the image that share one error
ROTATION_FACTOR, DIRECTION_FACTOR = 2.4, 3.0  # errors over what the scatter between parts predicts
_MIN_RESIDUAL_PX = 0.05  # no corner is tracked better than this


class CameraMotion(NamedTuple):
    """A motion, as in :class:`~conformodal.geometry.RelativeMotion`."""

    R_prev_next: FloatArray
    direction_prev: FloatArray


class TwoView(NamedTuple):
    """A motion and its inliers."""

    R_prev_next: FloatArray
    direction_prev: FloatArray
    inliers: BoolArray  # (n,)


def solve_poselib(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """LO-RANSAC over five points, then a robust fit to all inliers, of undistorted pixels (n, 2)."""
    model = camera.poselib()
    pose, info = poselib.estimate_relative_pose(pixels_prev, pixels_next, model, model, _RANSAC, _REFINEMENT)
    motion = invert_pose(pose.R, pose.t)
    return None if motion is None else TwoView(*motion, np.asarray(info["inliers"], dtype=np.bool_))


def solve_opencv(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> TwoView | None:
    """OpenCV's ``findEssentialMat`` with RANSAC and ``recoverPose``; parameters as for :func:`solve_poselib`."""
    intrinsics = camera.matrix
    cv2.setRNGSeed(0)
    matrices, mask = cv2.findEssentialMat(pixels_prev, pixels_next, intrinsics, cv2.RANSAC, 0.999, _EPIPOLAR_PX, 1000)
    if matrices is None or mask is None:
        return None
    inliers = mask.ravel() > 0
    pairs = pixels_prev[inliers], pixels_next[inliers]
    candidates = [  # five points may leave several matrices, one below the other
        cv2.recoverPose(E, *pairs, intrinsics, distanceThresh=_FARTHEST) for E in np.asarray(matrices).reshape(-1, 3, 3)
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


def estimate_relative_motion(
    pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera, n_at_start: int | None = None
) -> RelativeMotion:
    """Motion of the camera between two frames; a rotation where it is sound, a direction only with enough parallax.

    From the pixels (n, 2) of the same corners, as they are in the images. `n_at_start` counts the corners in the
    previous frame before tracking, which tells a blank frame from a cut.
    """
    n = len(pixels_prev)
    if n < MIN_TRACKS:
        blank = (n_at_start if n_at_start is not None else n) < MIN_TRACKS
        return RelativeMotion(MotionStatus.TOO_FEW if blank else MotionStatus.LOST, n_tracks=n)
    pixels_prev, pixels_next = camera.undistort(pixels_prev), camera.undistort(pixels_next)
    pixel = 2.0 / (camera.fx + camera.fy)  # radians
    flow = np.linalg.norm(pixels_next - pixels_prev, axis=1)
    if np.median(flow) < _REPEATED_FLOW_PX:
        return RelativeMotion(MotionStatus.REPEATED, np.eye(3), None, n, n, _REPEATED_FLOW_PX * pixel)
    pairs = _Pairs(pixels_prev, pixels_next, camera.bearings(pixels_prev), camera.bearings(pixels_next))
    cells = image_cells(pixels_prev, camera)
    return _pure_rotation(pairs, cells, pixel) or _two_view_motion(pairs, cells, pixel, camera)


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
    rotation, inliers = _fit_rotation(pairs, _MIN_PARALLAX_PX * pixel)
    if inliers.mean() < _TURNING_SHARE:
        return None
    used = pairs.take(inliers)
    sigma = _turning_spread(used, rotation, cells[inliers], pixel)
    return RelativeMotion(MotionStatus.LOW_PARALLAX, rotation, None, len(inliers), int(inliers.sum()), sigma)


def _two_view_motion(pairs: _Pairs, cells: IntArray, pixel: float, camera: PinholeCamera) -> RelativeMotion:
    n, view = len(cells), solve_poselib(pairs.pixels_prev, pairs.pixels_next, camera)
    n_inliers = 0 if view is None else int(view.inliers.sum())
    if view is None or n_inliers < max(MIN_TRACKS, _MIN_INLIER_SHARE * n):
        return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n, n_inliers=n_inliers)
    R_prev_next, direction, inliers = view
    used = pairs.take(inliers)
    spread = _motion_spreads(used, view, cells[inliers], pixel)
    status, rotation_sigma = MotionStatus.OK, spread.rotation
    if used.parallax(R_prev_next) < _MIN_PARALLAX_PX * pixel:
        status = MotionStatus.LOW_PARALLAX
    else:
        ways = plane_motions(used.pixels_prev, used.pixels_next, camera)
        directions = np.array([way.direction_prev for way in ways[:2]])
        if len(ways) > 1 and _angles(directions[:1], directions[1:])[0] > _PLANE_AMBIGUITY_RAD:
            # the rotation is one of two as well: as uncertain as they differ
            apart = trusted_rotation(ways[0].R_prev_next.T @ ways[1].R_prev_next).magnitude()
            status, rotation_sigma = MotionStatus.PLANE, float(np.hypot(rotation_sigma, apart))
    ok = status is MotionStatus.OK
    direction_sigma = spread.direction if ok else np.inf
    return RelativeMotion(status, R_prev_next, direction if ok else None, n, n_inliers, rotation_sigma, direction_sigma)


def plane_motions(pixels_prev: FloatArray, pixels_next: FloatArray, camera: PinholeCamera) -> list[CameraMotion]:
    """One or two motions that explain corners (n, 2) on one plane (Faugeras and Lustman 1988); none off a plane."""
    homography, _ = cv2.findHomography(pixels_prev, pixels_next, 0)
    if homography is None:
        return []
    mapped = np.column_stack((pixels_prev, np.ones(len(pixels_prev)))) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - pixels_next, axis=1)
    if not np.mean(off <= _EPIPOLAR_PX) >= _PLANE_SHARE:
        return []
    _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, camera.matrix)
    rays = camera.bearings(pixels_prev)
    motions = [
        invert_pose(R_next_prev, t)
        for R_next_prev, t, normal in zip(rotations, translations, normals, strict=True)
        if (rays @ normal[:, 0] > _BEHIND).all()
    ]
    return [motion for motion in motions if motion is not None]


def _fit_rotation(pairs: _Pairs, tolerance_rad: float) -> tuple[FloatArray, BoolArray]:
    """Rotation with ``rays_prev = R rays_next`` on most rays, and these: trimmed least squares, from all of them."""
    keep = np.ones(len(pairs.rays_prev), dtype=bool)
    for _ in range(_ROTATION_ROUNDS):
        # orthogonal Procrustes (Kabsch 1976); SciPy's align_vectors takes four times as long for a few hundred rays
        left, _, right = np.linalg.svd(pairs.rays_prev[keep].T @ pairs.rays_next[keep])
        left[:, 2] *= np.linalg.det(left) * np.linalg.det(right)
        matrix = left @ right
        error = _angles(pairs.rays_prev, pairs.rays_next @ matrix.T)
        before, keep = keep, error <= max(tolerance_rad, 2.0 * float(np.median(error)))
        if (keep == before).all():
            break
    return matrix, error <= tolerance_rad


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between unit vectors (n, 3), in radians; exact for small ones."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def image_cells(pixels: FloatArray, camera: PinholeCamera) -> IntArray:
    """Cell (n,) of every pixel (n, 2) in a grid of 4 x 3 over the image."""
    column = np.clip(pixels[:, 0] * _COLUMNS // camera.width, 0, _COLUMNS - 1)
    row = np.clip(pixels[:, 1] * _ROWS // camera.height, 0, _ROWS - 1)
    return (column * _ROWS + row).astype(np.int64)


class _MotionSpread(NamedTuple):
    """Standard deviations (radians) of a rotation about each axis, and of a direction along each orthogonal axis."""

    rotation: float
    direction: float


def _motion_spreads(pairs: _Pairs, motion: TwoView, cells: IntArray, pixel_rad: float) -> _MotionSpread:
    """Spreads of a motion from its inliers and their cells (n,) from :func:`image_cells`; ``inf`` if undetermined."""
    rays_prev, rays_next, R_prev_next, direction_prev = pairs.rays_prev, pairs.rays_next, *motion[:2]
    turned = rays_next @ R_prev_next.T
    normal, other = np.cross(direction_prev, turned), np.cross(direction_prev, rays_prev)
    size = np.sqrt((normal**2).sum(axis=1) + (other**2).sum(axis=1))
    # angle off the epipolar plane, and how it changes with a turn of the next camera and of the direction
    residual = (rays_prev * normal).sum(axis=1) / size
    sideways = np.linalg.svd(direction_prev[None])[2][1:].T
    by_turn = np.cross(rays_next, -other @ R_prev_next)
    by_direction = np.cross(turned, rays_prev) @ sideways
    jacobian = np.concatenate((by_turn, by_direction), axis=1) / size[:, None]
    sigma = max(float(np.median(np.abs(residual))) / MAD_OF_NORMAL, _MIN_RESIDUAL_PX * pixel_rad)
    covariance = _clustered(jacobian[:, None], cells, sigma)
    rotation, direction = np.trace(covariance[:3, :3]) / 3, np.trace(covariance[3:, 3:]) / 2
    return _MotionSpread(ROTATION_FACTOR * float(np.sqrt(rotation)), DIRECTION_FACTOR * float(np.sqrt(direction)))


def _turning_spread(pairs: _Pairs, R_prev_next: FloatArray, cells: IntArray, pixel_rad: float) -> float:
    """Standard deviation of a pure rotation about each axis, as :func:`_motion_spreads`."""
    turned = pairs.rays_next @ R_prev_next.T
    off = np.linalg.norm(pairs.rays_prev - turned, axis=1)
    jacobian = -cross_matrices(turned)  # a turn w in the previous frame moves a ray by w x ray
    size = max(float(np.median(off)) / MEDIAN_OF_NORM2, _MIN_RESIDUAL_PX * pixel_rad)
    return ROTATION_FACTOR * float(np.sqrt(np.trace(_clustered(jacobian, cells, size)) / 3))


def _clustered(jacobian: FloatArray, cells: IntArray, sigma: float) -> FloatArray:
    """Covariance of least squares with rows `jacobian` (n, m, p), if each cell has one error of spread `sigma`."""
    p = jacobian.shape[2]
    information = np.einsum("nmi,nmj->ij", jacobian, jacobian)
    if not np.linalg.cond(information) < 1e12:
        return np.full((p, p), np.inf)
    pulls = np.zeros((_COLUMNS * _ROWS, *jacobian.shape[1:]))
    np.add.at(pulls, cells, jacobian)
    inverse = np.linalg.inv(information)
    return np.asarray(sigma**2 * inverse @ np.einsum("cmi,cmj->ij", pulls, pulls) @ inverse)
