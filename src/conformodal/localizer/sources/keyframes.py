"""A map of keyframes and landmarks: retrieval by global descriptors, then PnP on matched local features."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import poselib
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.features.local import LocalFeatures, match
from conformodal.geometry import PinholeCamera, cross_matrices, rigid_motions
from conformodal.geometry.adjustment import MEDIAN_OF_NORM2
from conformodal.localizer.measurement import PoseMeasurement
from conformodal.localizer.settings import GUIDING, PNP, RETRIEVAL


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Keyframes, which are frames with known poses, and landmarks, which are their triangulated corners.

    Landmarks belong to adjusted poses of the keyframes. Rolling shutters, clocks and reference poses make neighbours
    deviate alike from the given ones. The weighted mean of the neighbours' `corrections` is therefore subtracted from
    an estimate, which brings it to the given frame; their scatter is part of its standard deviation.
    """

    camera: PinholeCamera  # without distortion; see fit_camera
    T_pose_cam: FloatArray  # (4, 4) from the camera's frame to the one whose poses are given
    shutter: FloatArray  # (2,), see PinholeCamera.at_pose_time
    poses_se3: FloatArray  # (n, 4, 4) of the keyframes, as given
    global_descriptors: npt.NDArray[np.float16]  # (n, G)
    starts: IntArray  # (n + 1,) landmarks of keyframe i are starts[i] to starts[i + 1]
    points_xyz: Float32Array  # (N, 3) metres, world
    descriptors: UInt8Array  # (N, 32)
    depth_m: float  # median depth of the scene
    corrections: FloatArray  # (n, 6) adjusted minus given pose of each keyframe: metres and a rotation vector, world

    @cached_property
    def _descriptors(self) -> Float32Array:
        return self.global_descriptors.astype(np.float32)  # products of halves are slow

    def localize(
        self, image: LocalFeatures, hidden: BoolArray | None = None, matches: dict[int, IntArray] | None = None
    ) -> list[PoseMeasurement]:
        """Absolute pose estimates of an image: one PnP hypothesis for each of the similar retrieval clusters.

        Standard deviations come from the reprojection residuals and the scatter of the corrections, up to a factor that
        :class:`~conformodal.localizer.measurement.ErrorModel` learns. Keyframes in `hidden` (n,) are left out.
        `matches` caches those of the image by keyframe.
        """
        shown = ~hidden if hidden is not None else np.ones(len(self.poses_se3), dtype=bool)
        matches, image = {} if matches is None else matches, image.at_pose_time(self.shutter, self.camera)
        places = self._retrieve(image.global_descriptor, shown)
        estimates = (self._solve(image, near, shown, matches) for near in places)
        return [estimate for estimate in estimates if estimate is not None]

    def _retrieve(self, descriptor: Float32Array, shown: BoolArray) -> list[IntArray]:
        """Keyframes similar to an image, clustered by position, in order of similarity."""
        alike = (self._descriptors @ descriptor).astype(np.float64)
        alike[~shown | (np.diff(self.starts) < PNP.min_inliers)] = -np.inf
        order = np.argsort(-alike, kind="stable")[: RETRIEVAL.retrieved]
        order = order[np.isfinite(alike[order])]
        clusters: list[IntArray] = []
        while order.size and len(clusters) < RETRIEVAL.clusters:
            if clusters and 1 - alike[order[0]] > RETRIEVAL.max_distance_ratio * (1 - alike[clusters[0][0]]):
                break
            apart = np.linalg.norm(self.poses_se3[order, :3, 3] - self.poses_se3[order[0], :3, 3], axis=1)
            here = apart < RETRIEVAL.radius * self.depth_m
            clusters.append(self._spread(order[here], RETRIEVAL.others if clusters else RETRIEVAL.first))
            order = order[~here]
        return clusters

    def _spread(self, order: IntArray, most: int) -> IntArray:
        """The first keyframes in an order that differ from each other: nearly the same view says the same again."""
        chosen: list[int] = []
        for i in order.tolist():
            if len(chosen) < most and (not chosen or self._apart(self.poses_se3[i], chosen).min() > RETRIEVAL.spread):
                chosen.append(i)
        return np.array(chosen)

    def _apart(self, T_world_pose: FloatArray, frames: list[int] | slice = slice(None)) -> FloatArray:
        """Distances of keyframes from a pose, in scene depths plus radians."""
        poses = self.poses_se3[frames]
        apart = np.linalg.norm(poses[:, :3, 3] - T_world_pose[:3, 3], axis=1) / self.depth_m
        return np.asarray(apart + np.arccos(np.clip(poses[:, :3, 2] @ T_world_pose[:3, 2], -1, 1)))

    def _solve(
        self, image: LocalFeatures, near: IntArray, shown: BoolArray, matches: dict[int, IntArray]
    ) -> PoseMeasurement | None:
        for frame in near.tolist():
            if frame not in matches:
                pairs = match(image.descriptors, self.descriptors[self.starts[frame] : self.starts[frame + 1]])
                matches[frame] = np.add(pairs, (0, self.starts[frame]))
        corners, landmarks = np.concatenate([matches[frame] for frame in near.tolist()]).T
        points = self.points_xyz[landmarks].astype(np.float64)
        pixels = image.pixels[corners]
        if len(pixels) < PNP.min_inliers:
            return None
        pose, info = poselib.estimate_absolute_pose(pixels, points, self.camera.poselib(), PNP.ransac, PNP.refinement)
        inliers = np.asarray(info["inliers"], dtype=np.bool_)
        if inliers.sum() < PNP.min_inliers:
            return None
        # a corner matched with several keyframes is one observation, so it counts once
        share = len(np.unique(corners[inliers])) / len(np.unique(corners))
        T_world_cam = _camera_to_world(pose)
        if inliers.sum() >= GUIDING.least_inliers:
            corners, landmarks = self._guided(image, T_world_cam, shown)
            points, pixels = self.points_xyz[landmarks].astype(np.float64), image.pixels[corners]
            if len(pixels) < PNP.min_inliers:
                return None
            pose, _ = poselib.refine_absolute_pose(pixels, points, pose, self.camera.poselib(), PNP.refinement)
            T_world_cam = _camera_to_world(pose)
            pixels_seen, ahead = self._projected(points, T_world_cam)
            inliers = ahead & (np.linalg.norm(pixels_seen - pixels, axis=1) < PNP.ransac["max_reproj_error"])
            if inliers.sum() < PNP.min_inliers:
                return None
        sigmas = self._spreads(pixels[inliers], points[inliers], T_world_cam[:3, :3], T_world_cam[:3, 3])
        if sigmas is None:
            return None
        T_world_pose = T_world_cam @ np.linalg.inv(self.T_pose_cam)
        off, scatter, apart = self._correction(T_world_pose, shown)
        sigma_m, sigma_rad = np.hypot(sigmas, scatter).tolist()
        turn = Rotation.from_rotvec(-off[3:]) * Rotation.from_matrix(T_world_pose[:3, :3])
        position, quat = T_world_pose[:3, 3] - off[:3], turn.as_quat(scalar_first=True)
        agreeing = np.unique(corners[inliers])
        return PoseMeasurement(
            position,
            quat,
            sigma_m,
            sigma_rad,
            n_inliers=len(agreeing),
            inlier_share=share,
            image_share=self._share_of_image(image.pixels[agreeing]),
            distance_to_known=apart,
        )

    def _guided(self, image: LocalFeatures, T_world_cam: FloatArray, shown: BoolArray) -> tuple[IntArray, IntArray]:
        """Corners and landmarks (m,) that match where the keyframes nearest to a pose say that they are."""
        order = np.argsort(np.where(shown, self._apart(T_world_cam @ np.linalg.inv(self.T_pose_cam)), np.inf))
        near = self._spread(order[: min(GUIDING.considered, int(shown.sum()))], GUIDING.keyframes)
        landmarks = np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in near.tolist()])
        pixels_seen, ahead = self._projected(self.points_xyz[landmarks].astype(np.float64), T_world_cam)
        landmarks, pixels_seen = landmarks[ahead], pixels_seen[ahead]
        count = min(GUIDING.corners, len(image.pixels))
        away, corners = KDTree(image.pixels).query(
            pixels_seen, np.arange(1, count + 1), distance_upper_bound=GUIDING.radius_px
        )
        rows, columns = np.nonzero(np.isfinite(away))
        corners = np.asarray(corners)[rows, columns]
        differ = np.unpackbits(image.descriptors[corners] ^ self.descriptors[landmarks[rows]], axis=1).sum(axis=1)
        best = np.lexsort((differ, rows))
        best = best[np.unique(rows[best], return_index=True)[1]]
        best = best[differ[best] < GUIDING.most_bits]
        return corners[best], landmarks[rows[best]]

    def _projected(self, points: FloatArray, T_world_cam: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points, and whether these lie ahead of the camera."""
        local = (points - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
        ahead = local[:, 2] > 1e-3
        plane = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
        camera = self.camera
        return plane * (camera.fx, camera.fy) + (camera.cx, camera.cy), ahead

    def _share_of_image(self, pixels: FloatArray) -> float:
        """Share of the image over which pixels (m, 2) are spread: 1 if evenly over all of it."""
        if len(pixels) < 3:
            return 0.0
        area = 12 * np.sqrt(max(float(np.linalg.det(np.cov(pixels.T))), 0.0))
        return float(area / (self.camera.width * self.camera.height))

    def _correction(self, T_world_pose: FloatArray, shown: BoolArray) -> tuple[FloatArray, FloatArray, float]:
        """Deviations of nearby keyframes: mean (6,), scatter per axis (2,) in m and rad, and the least distance."""
        apart = self._apart(T_world_pose)
        away = float(apart[shown].min())
        corrected = np.flatnonzero(shown & np.isfinite(self.corrections).all(axis=1))
        if corrected.size == 0:
            return np.zeros(6), np.zeros(2), away
        nearest = corrected[np.argsort(apart[corrected], kind="stable")[: PNP.corrected_by]]
        corrections, weights = self.corrections[nearest], 1 / (apart[nearest] + PNP.least_distance)
        mean = np.average(corrections, axis=0, weights=weights)
        variance = np.average((corrections - mean) ** 2, axis=0, weights=weights)
        return mean, np.sqrt([variance[:3].mean(), variance[3:].mean()]), away

    def _spreads(
        self, pixels: FloatArray, points: FloatArray, R_world_cam: FloatArray, centre: FloatArray
    ) -> tuple[float, float] | None:
        """Standard deviations per axis of position (metres) and rotation (radians), propagated from the residuals."""
        local = (points - centre) @ R_world_cam
        depth = local[:, 2]
        if not (depth > 1e-6).all():
            return None
        plane = local[:, :2] / depth[:, None]
        off = np.linalg.norm(plane - self.camera.on_plane(pixels), axis=1)
        least = 2 * PNP.least_residual_px / (self.camera.fx + self.camera.fy)
        residual = max(float(np.median(off)) / MEDIAN_OF_NORM2, least)
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / depth
        by_point[:, :, 2] = -plane / depth[:, None]
        slopes = np.concatenate((-by_point, by_point @ cross_matrices(local)), axis=2).reshape(-1, 6)
        information = slopes.T @ slopes / residual**2
        if np.linalg.cond(information) > 1e12:
            return None
        variance = np.diag(np.linalg.inv(information))
        return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean()))


def _camera_to_world(pose: poselib.CameraPose) -> FloatArray:
    R_world_cam = np.asarray(pose.R).T
    return rigid_motions(R_world_cam, -R_world_cam @ np.asarray(pose.t))
