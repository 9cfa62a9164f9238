"""Keyframes with their landmarks, and the pose of another image from those that look like it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt
import poselib
from scipy.spatial.transform import Rotation

from conformodal.poses import PinholeCamera, PoseFix

from ..two_view import poselib_camera
from .described import Described, match, product

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# So many keyframes that look like an image are matched, of the place most like it and of others; and so many places.
NEAR, NEAR_ELSEWHERE, PLACES = 6, 3, 8
_CROWD = 200  # keyframes looked at for places
# A place: keyframes no further apart than this share of the scene's depth.
_PLACE = 0.5
# Another place is looked at if its nearest keyframe is at most so many times as unlike the image as the nearest of all.
_UNLIKE = 5.0
MIN_INLIERS = 12
# Fixes are corrected by so many keyframes nearby, weighed by one over their distance: turns in radians and places in
# units of the scene's depth count alike, and no keyframe is nearer than the least.
_CORRECTED_BY, _LEAST_APART = 6, 0.01
_ABSOLUTE = {"max_reproj_error": 6.0, "max_iterations": 1000, "min_iterations": 50, "seed": 0}
# more steps take long and hardly move a pose
_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 1.0, "max_iterations": 10}
_LEAST_RESIDUAL_PX = 0.5
_MEDIAN_OF_NORM2 = 1.177


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Keyframes: frames with known poses, whose corners have places in the world.

    Attributes
    ----------
    camera
        Without distortion; fitted, see :func:`~conformodal.motion.landmarks.camera_fit.fit_camera`.
    T_pose_cam
        (4, 4) from the camera's frame to the one whose poses are given.
    poses_se3
        (n, 4, 4) of the keyframes, as given.
    thumbnails
        (n, 768), see :class:`Described`.
    starts
        (n + 1,) landmarks of keyframe i are ``starts[i]`` to ``starts[i + 1]``.
    points_xyz, descriptors
        (N, 3) metres, world; (N, 32).
    depth_m
        Median depth of the scene.
    corrections
        (n, 6) by how much each keyframe's own fix is off when its landmarks are hidden: metres and a rotation vector,
        world; NaN where there is none. Fixes nearby are off the same way (rolling shutters, clocks and reference
        poses err together), so their weighted mean is taken off, and a fix is as uncertain as they differ.
    """

    camera: PinholeCamera
    T_pose_cam: FloatArray
    poses_se3: FloatArray
    thumbnails: npt.NDArray[np.float16]
    starts: IntArray
    points_xyz: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.uint8]
    depth_m: float
    corrections: FloatArray

    @cached_property
    def _thumbnails(self) -> npt.NDArray[np.float32]:
        return self.thumbnails.astype(np.float32)  # products of halves are slow

    @property
    def size(self) -> int:
        """Stored numbers of four bytes."""
        stored = (self.thumbnails, self.points_xyz, self.descriptors, self.poses_se3, self.corrections)
        return sum(array.nbytes for array in stored) // 4

    def corrected(self, corrections: FloatArray) -> Self:
        """The same map with other corrections."""
        return replace(self, corrections=corrections)

    def fixes(self, image: Described, hidden: BoolArray | None = None, most: int = PLACES) -> list[PoseFix]:
        """Poses of an image: at most one a place that looks like it.

        Spreads are what the corners' residuals make of the pose, and how much corrections nearby differ: about as large
        as its error, but for a factor.

        Parameters
        ----------
        image
            From :func:`~conformodal.motion.landmarks.describe`.
        hidden
            (n,) keyframes to leave out.
        most
            Places to look at, the one most like the image first.
        """
        shown = ~hidden if hidden is not None else np.ones(len(self.poses_se3), dtype=bool)
        found = (self._fix(image, near, shown) for near in self._places(image.thumbnail, shown)[:most])
        return [fix for fix in found if fix is not None]

    def _places(self, thumbnail: npt.NDArray[np.float32], shown: BoolArray) -> list[IntArray]:
        """Keyframes that look like an image, place by place, the most alike first."""
        alike = product(self._thumbnails, thumbnail).astype(np.float64)
        alike[~shown | (np.diff(self.starts) < MIN_INLIERS)] = -np.inf
        order = np.argsort(-alike, kind="stable")[:_CROWD]
        order = order[np.isfinite(alike[order])]
        found: list[IntArray] = []
        while order.size and len(found) < PLACES:
            if found and 1 - alike[order[0]] > _UNLIKE * (1 - alike[found[0][0]]):
                break
            apart = np.linalg.norm(self.poses_se3[order, :3, 3] - self.poses_se3[order[0], :3, 3], axis=1)
            here = apart < _PLACE * self.depth_m
            found.append(order[here][: NEAR_ELSEWHERE if found else NEAR])
            order = order[~here]
        return found

    def _fix(self, image: Described, near: IntArray, shown: BoolArray) -> PoseFix | None:
        corners, points = self._matched(image, near)
        pixels = image.pixels[corners]
        if len(pixels) < MIN_INLIERS:
            return None
        pose, info = poselib.estimate_absolute_pose(pixels, points, poselib_camera(self.camera), _ABSOLUTE, _REFINEMENT)
        inliers = np.asarray(info["inliers"], dtype=np.bool_)
        if inliers.sum() < MIN_INLIERS:
            return None
        R_world_cam = np.asarray(pose.R).T
        centre = -R_world_cam @ np.asarray(pose.t)
        sigmas = self._spreads(pixels[inliers], points[inliers], R_world_cam, centre)
        if sigmas is None:
            return None
        T_world_cam = np.eye(4)
        T_world_cam[:3, :3], T_world_cam[:3, 3] = R_world_cam, centre
        T_world_pose = T_world_cam @ np.linalg.inv(self.T_pose_cam)
        off, scatter, apart = self._correction(T_world_pose, shown)
        sigma_m, sigma_rad = np.hypot(sigmas, scatter).tolist()
        turn = Rotation.from_rotvec(-off[3:]) * Rotation.from_matrix(T_world_pose[:3, :3])
        position, quat = T_world_pose[:3, 3] - off[:3], turn.as_quat(scalar_first=True)
        # a corner is matched with several keyframes: counted each time, chance agreements pass for evidence
        agreeing, matched = np.unique(corners[inliers]), np.unique(corners)
        return PoseFix(
            position,
            quat,
            sigma_m,
            sigma_rad,
            n_inliers=len(agreeing),
            inlier_share=len(agreeing) / len(matched),
            image_share=self._share_of_image(image.pixels[agreeing]),
            apart=apart,
        )

    def _share_of_image(self, pixels: FloatArray) -> float:
        """How much of the image pixels (m, 2) are spread over: an even spread covers it all."""
        if len(pixels) < 3:
            return 0.0
        area = 12 * np.sqrt(max(float(np.linalg.det(np.cov(pixels.T))), 0.0))
        return float(area / (self.camera.width * self.camera.height))

    def _matched(self, image: Described, near: IntArray) -> tuple[IntArray, FloatArray]:
        """Rows of the image's corners, (m,), and the landmarks that they look like, (m, 3)."""
        corners, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
        for frame in near.tolist():
            mine = slice(self.starts[frame], self.starts[frame + 1])
            pairs = match(image.descriptors, self.descriptors[mine])
            corners.append(pairs[:, 0])
            points.append(self.points_xyz[mine][pairs[:, 1]].astype(np.float64))
        return np.concatenate(corners), np.concatenate(points)

    def _correction(self, T_world_pose: FloatArray, shown: BoolArray) -> tuple[FloatArray, FloatArray, float]:
        """By how much fixes nearby are off.

        Returns the mean (6,), its spread between keyframes an axis, (2,) in m and rad, and how far the nearest keyframe
        is, in units of the depth and radians.
        """
        apart = np.linalg.norm(self.poses_se3[:, :3, 3] - T_world_pose[:3, 3], axis=1) / self.depth_m
        apart += np.arccos(np.clip(self.poses_se3[:, :3, 2] @ T_world_pose[:3, 2], -1, 1))
        away = float(apart[shown].min())
        known = np.flatnonzero(shown & np.isfinite(self.corrections).all(axis=1))
        if known.size == 0:
            return np.zeros(6), np.zeros(2), away
        nearest = known[np.argsort(apart[known], kind="stable")[:_CORRECTED_BY]]
        found, weights = self.corrections[nearest], 1 / (apart[nearest] + _LEAST_APART)
        mean = np.average(found, axis=0, weights=weights)
        variance = np.average((found - mean) ** 2, axis=0, weights=weights)
        return mean, np.sqrt([variance[:3].mean(), variance[3:].mean()]), away

    def _spreads(
        self, pixels: FloatArray, points: FloatArray, R_world_cam: FloatArray, centre: FloatArray
    ) -> tuple[float, float] | None:
        """Spreads of position (metres) and rotation (radians) that the residuals make, per axis."""
        local = (points - centre) @ R_world_cam
        depth = local[:, 2]
        if not (depth > 1e-6).all():
            return None
        plane = local[:, :2] / depth[:, None]
        off = np.linalg.norm(plane - self.camera.on_plane(pixels), axis=1)
        least = 2 * _LEAST_RESIDUAL_PX / (self.camera.fx + self.camera.fy)
        residual = max(float(np.median(off)) / _MEDIAN_OF_NORM2, least)
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / depth
        by_point[:, :, 2] = -plane / depth[:, None]
        x, y, z = local.T
        zero = np.zeros_like(x)
        cross = np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)
        slopes = np.concatenate((-by_point, by_point @ cross), axis=2).reshape(-1, 6)
        information = slopes.T @ slopes / residual**2
        if np.linalg.cond(information) > 1e12:
            return None
        variance = np.diag(np.linalg.inv(information))
        return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean()))
