"""A map of landmarks: retrieval by global descriptors, PnP on matched local features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import poselib
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from conformodal.core.progress import Progress
from conformodal.features.local import Descriptors, LocalFeatures, Matcher, match, similar_enough
from conformodal.geometry import PinholeCamera, rigid_motions
from conformodal.geometry.adjustment import MAD_OF_NORMAL, MEDIAN_OF_NORM2
from conformodal.geometry.map_poses import RigCalibration
from conformodal.geometry.poses import trusted_rotation
from conformodal.geometry.triangulation import local_origin
from conformodal.localizer.evidence import LandmarkView, PoseMeasurement
from conformodal.localizer.landmark_settings import LandmarkSettings

MIN_INLIERS = 12  # of a pose
_LEAST_DISTANCE = 1e-3  # one minus the cosine of two descriptors of one view: these are of half precision
_RANSAC = {"min_iterations": 50, "seed": 0}
_REFINEMENT = {"loss_type": "CAUCHY", "loss_scale": 1.0, "max_iterations": 10}  # more take long and hardly move a pose


class _Solution(NamedTuple):
    """A pose and the matches that agree with it: corners and landmarks (m,)."""

    T_world_cam: FloatArray
    corners: IntArray
    landmarks: IntArray
    inlier_share: float  # of the corners that matched at first


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """Keyframes, which are frames with known poses, and landmarks, which are their triangulated corners.

    Landmarks belong to adjusted poses of the keyframes. Rolling shutters, clocks and reference poses make neighbours
    deviate alike from the given ones. The weighted mean of the neighbours' `corrections` is therefore subtracted from
    an estimate, which brings it to the given frame; their scatter is part of its standard deviation.

    Poses and points are relative to an origin, so that single precision and squares lose nothing far from the world's.
    """

    camera: PinholeCamera  # without distortion
    T_pose_cam: FloatArray  # (4, 4) from the camera's frame to the one whose poses are given
    shutter: FloatArray  # (2,), see PinholeCamera.compensate_rolling_shutter
    origin_xyz: FloatArray  # (3,) metres, world; whole kilometres: near the world's origin it is the same
    poses_se3: FloatArray  # (n, 4, 4) of the keyframes, as given but for the origin
    global_descriptors: npt.NDArray[np.float16]  # (n, G)
    starts: IntArray  # (n + 1,) landmarks of keyframe i are starts[i] to starts[i + 1]
    points_xyz: Float32Array  # (N, 3) metres
    descriptors: Descriptors  # (N, B)
    corrections: FloatArray  # (n, 6) adjusted minus given pose of each keyframe: metres and a rotation vector, world
    depth_m: float  # median depth of the scene
    settings: LandmarkSettings = field(default_factory=LandmarkSettings)

    @classmethod
    def build(
        cls,
        features: Sequence[LocalFeatures],
        poses_se3: FloatArray,
        camera: PinholeCamera,
        depth_m: float,
        progress: Progress | None = None,
        matcher: Matcher | None = None,
        settings: LandmarkSettings | None = None,
    ) -> Self:
        """Map n frames with known poses (n, 4, 4); a shared `matcher` reuses matches of other maps."""
        from .mapping import triangulate_frames  # noqa: PLC0415 - only learning needs it

        origin_xyz = local_origin(poses_se3[:, :3, 3])
        poses_se3 = poses_se3.copy()
        poses_se3[:, :3, 3] -= origin_xyz
        matcher, settings = matcher or Matcher(), settings or LandmarkSettings()
        mapped = triangulate_frames(features, poses_se3, camera, depth_m, progress, matcher, settings.mapping)
        global_descriptors = np.array([one.global_descriptor for one in features], dtype=np.float16)
        return cls(
            *mapped.rig,
            origin_xyz,
            poses_se3,
            global_descriptors,
            mapped.starts,
            mapped.points_xyz,
            mapped.descriptors,
            mapped.corrections,
            depth_m,
            settings,
        )

    def extended(self, features: Sequence[LocalFeatures], poses_se3: FloatArray, progress: Progress | None) -> Self:
        """The map with m more frames, whose poses (m, 4, 4) are known; what is mapped stays as it is.

        Corners of the new frames are matched with each other's, and with the landmarks of keyframes that look at the
        same: these are where the map projects them.
        """
        from .mapping import KnownFrames, triangulate_beside  # noqa: PLC0415 - only learning needs it

        moved = poses_se3.copy()
        moved[:, :3, 3] -= self.origin_xyz
        rig = RigCalibration(self.camera, self.T_pose_cam, self.shutter)
        shift, turn = np.nanmedian(np.abs(self.corrections), axis=0).reshape(2, 3).mean(axis=1) / MAD_OF_NORMAL
        least = self.settings.mapping.min_sigma
        sigmas = np.repeat([max(turn, least), max(shift, least * self.depth_m)], 3)
        known = KnownFrames(self._projections(), self.poses_se3, self._poses_cam, rig, sigmas)
        added = triangulate_beside(known, features, moved, self.depth_m, progress, self.settings.mapping)
        described = np.array([one.global_descriptor for one in features], dtype=np.float16)
        return replace(
            self,
            poses_se3=np.concatenate((self.poses_se3, moved)),
            global_descriptors=np.concatenate((self.global_descriptors, described)),
            starts=np.concatenate((self.starts, self.starts[-1] + added.starts[1:])),
            points_xyz=np.concatenate((self.points_xyz, added.points_xyz)),
            descriptors=np.concatenate([self.descriptors, added.descriptors]),
            corrections=np.concatenate((self.corrections, added.corrections)),
        )

    @property
    def _poses_cam(self) -> FloatArray:
        """(n, 4, 4) adjusted ``T_world_cam`` of the keyframes."""
        off = np.nan_to_num(self.corrections)
        turned = Rotation.from_rotvec(off[:, 3:]).as_matrix() @ self.poses_se3[:, :3, :3]
        return np.asarray(rigid_motions(turned, self.poses_se3[:, :3, 3] + off[:, :3]) @ self.T_pose_cam)

    def _projections(self) -> list[LocalFeatures]:
        """The landmarks of each keyframe as its corners."""
        keyframes = []
        nothing = np.empty(0, np.float32)
        for i, T_world_cam in enumerate(self._poses_cam):
            mine = slice(self.starts[i], self.starts[i + 1])
            pixels, _ = self._projected(self.points_xyz[mine].astype(np.float64), T_world_cam)
            keyframes.append(LocalFeatures(pixels, self.descriptors[mine], nothing))
        return keyframes

    @cached_property
    def _centres(self) -> FloatArray:
        return self.poses_se3[:, :3, 3].copy()

    @cached_property
    def _forward(self) -> FloatArray:
        """(n, 3) where the keyframes look."""
        return self.poses_se3[:, :3, 2].copy()

    @cached_property
    def _descriptors(self) -> Float32Array:
        return self.global_descriptors.astype(np.float32)  # products of halves are slow

    def localize(
        self, image: LocalFeatures, hidden: BoolArray | None = None, matches: dict[int, IntArray] | None = None
    ) -> list[PoseMeasurement]:
        """Absolute pose estimates of an image: at most one PnP hypothesis for each of the similar retrieval clusters.

        Once a second matching has confirmed a pose, clusters of its place are left out; rivals are solved from their
        first keyframe alone. Standard deviations come from the reprojection residuals and the scatter of the
        corrections, up to a factor that :class:`~conformodal.localizer.evidence.ErrorModel` learns. Keyframes in
        `hidden` (n,) are left out. `matches` caches those of the image by keyframe.
        """
        shown = ~hidden if hidden is not None else np.ones(len(self.poses_se3), dtype=bool)
        matches, image = {} if matches is None else matches, image.compensate_rolling_shutter(self.shutter, self.camera)
        estimates, settings = list[PoseMeasurement](), self.settings.pose
        guided: list[FloatArray] = []  # the poses that a second matching has confirmed
        for near in self._retrieve(image.global_descriptor, shown):
            first = self._matched(image, near[:1], matches)
            if any(self._agree(first, image, pose) for pose in guided):
                continue
            pairs = first if guided else self._matched(image, near, matches)
            samples = settings.max_samples_of_rival if guided else settings.max_samples
            solution = self._solve(image, pairs, shown, samples)
            estimate = None if solution is None else self._measured(image, solution, shown)
            if solution is not None and estimate is not None:
                estimates.append(estimate)
                if len(solution.corners) >= settings.min_guiding_inliers:
                    guided.append(solution.T_world_cam)
        return estimates

    def carry(self, image: LocalFeatures, view: LandmarkView) -> PoseMeasurement | None:
        """The pose of an image, refined from that of a view whose corners were followed into the image.

        `view` names the landmarks of corners of the image, and the pose of the image before.
        """
        image = image.compensate_rolling_shutter(self.shutter, self.camera)
        R_cam_world = view.T_world_cam[:3, :3].T
        before = poselib.CameraPose()
        before.R, before.t = R_cam_world, -R_cam_world @ view.T_world_cam[:3, 3]
        solution = self._refined(image, before, view.corners, view.landmarks)
        return None if solution is None else self._measured(image, solution, np.ones(len(self.poses_se3), np.bool_))

    def turn_for(self, position_xyz: FloatArray, quat_wxyz: FloatArray) -> float:
        """Angle in radians by which an image from about a pose is turned to be matched; 0 where it need not be.

        That of the roll to the least turned of the keyframes with a similar view.
        """
        expected = Rotation.from_quat(quat_wxyz, scalar_first=True)
        T_world_pose = rigid_motions(expected.as_matrix(), position_xyz - self.origin_xyz)
        near = np.argsort(self._apart(T_world_pose), kind="stable")[: self.settings.pose.n_rolls]
        between = Rotation.from_matrix(self.poses_se3[near, :3, :3]).inv() * expected
        about = Rotation.from_matrix(self.T_pose_cam[:3, :3])
        quats = (about.inv() * between * about).as_quat(scalar_first=True)
        rolls = 2 * np.arctan2(quats[:, 3], quats[:, 0])
        rolls = np.mod(rolls + np.pi, 2 * np.pi) - np.pi
        least = float(rolls[np.argmin(np.abs(rolls))])
        return least if abs(least) > self.settings.pose.matched_roll_rad else 0.0

    def _matched(self, image: LocalFeatures, frames: IntArray, matches: dict[int, IntArray]) -> IntArray:
        """Corners of an image and landmarks of some keyframes (m, 2) that match."""
        missing = [frame for frame in frames.tolist() if frame not in matches]
        landmarks = [self.descriptors[self.starts[frame] : self.starts[frame + 1]] for frame in missing]
        for frame, pairs in zip(missing, match(image.descriptors, landmarks), strict=True):
            matches[frame] = np.add(pairs, (0, self.starts[frame]))
        return np.concatenate([matches[frame] for frame in frames.tolist()])

    def _agree(self, pairs: IntArray, image: LocalFeatures, T_world_cam: FloatArray) -> bool:
        """Whether more matches of a keyframe agree with a pose than by chance: it shows the same place."""
        pixels, ahead = self._projected(self.points_xyz[pairs[:, 1]].astype(np.float64), T_world_cam)
        settings = self.settings.pose
        agree = ahead & (np.linalg.norm(pixels - image.pixels[pairs[:, 0]], axis=1) < settings.max_reprojection_px)
        return bool(agree.sum() >= max(settings.min_agreeing, settings.min_agreeing_share * len(pairs)))

    def _retrieve(self, descriptor: Float32Array, shown: BoolArray) -> list[IntArray]:
        """Keyframes similar to an image, clustered by position, in order of similarity."""
        alike = (self._descriptors @ descriptor).astype(np.float64)
        alike[~shown | (np.diff(self.starts) < MIN_INLIERS)] = -np.inf
        settings = self.settings.pose
        order = np.argsort(-alike, kind="stable")[: settings.n_retrieved]
        order = order[np.isfinite(alike[order])]
        # descriptors are rounded, so that of two places that are equally similar one may seem to have no distance
        nearest = max(1 - float(alike[order].max(initial=0.0)), _LEAST_DISTANCE)
        clusters: list[IntArray] = []
        while order.size and len(clusters) < settings.max_clusters:
            if clusters and 1 - alike[order[0]] > settings.max_distance_ratio * nearest:
                break
            apart = np.linalg.norm(self._centres[order] - self._centres[order[0]], axis=1)
            here = apart < settings.radius_depths * self.depth_m
            clusters.append(self._spread(order[here], settings.n_others if clusters else settings.n_first))
            order = order[~here]
        return clusters

    def _spread(self, order: IntArray, most: int) -> IntArray:
        """The first keyframes in an order that differ from each other: nearly the same view says the same again."""
        chosen: list[int] = []
        while order.size and len(chosen) < most:
            chosen.append(int(order[0]))
            order = order[self._apart(self.poses_se3[chosen[-1]], order) > self.settings.pose.spread]
        return np.array(chosen)

    def _apart(self, T_world_pose: FloatArray, frames: IntArray | slice = slice(None)) -> FloatArray:
        """Distances of keyframes from a pose, in scene depths plus radians."""
        off = self._centres[frames] - T_world_pose[:3, 3]
        apart = np.sqrt(np.einsum("ij,ij->i", off, off)) / self.depth_m
        return np.asarray(apart + np.arccos(np.clip(self._forward[frames] @ T_world_pose[:3, 2], -1, 1)))

    def _solve(self, image: LocalFeatures, pairs: IntArray, shown: BoolArray, samples: int) -> _Solution | None:
        """The pose of an image from matches (m, 2) of corners and landmarks, some of them right."""
        # a corner that matches several keyframes is one observation
        alike, _ = similar_enough(image.descriptors[pairs[:, 0]], self.descriptors[pairs[:, 1]])
        corners, landmarks = pairs[_most_similar(pairs[:, 0], alike)].T
        points, pixels = self.points_xyz[landmarks].astype(np.float64), image.pixels[corners]
        if len(pixels) < MIN_INLIERS:
            return None
        settings = self.settings.pose
        ransac = _RANSAC | {"max_reproj_error": settings.max_reprojection_px, "max_iterations": samples}
        pose, info = poselib.estimate_absolute_pose(pixels, points, self.camera.poselib(), ransac, _REFINEMENT)
        inliers = np.asarray(info["inliers"], dtype=np.bool_)
        if inliers.sum() < MIN_INLIERS:
            return None
        share, T_world_cam = float(inliers.mean()), _camera_to_world(pose)
        if inliers.sum() >= settings.min_guiding_inliers:
            guided = self._refined(image, pose, *self._guided(image, T_world_cam, shown))
            return None if guided is None else guided._replace(inlier_share=share)
        return _Solution(T_world_cam, corners[inliers], landmarks[inliers], share)

    def _refined(
        self, image: LocalFeatures, pose: poselib.CameraPose, corners: IntArray, landmarks: IntArray
    ) -> _Solution | None:
        """The pose refined from matches (m,) of corners and landmarks, and those that agree; None of too few."""
        if len(corners) < MIN_INLIERS:
            return None
        pixels, points = image.pixels[corners], self.points_xyz[landmarks].astype(np.float64)
        refined, _ = poselib.refine_absolute_pose(pixels, points, pose, self.camera.poselib(), _REFINEMENT)
        T_world_cam = _camera_to_world(refined)
        projected, ahead = self._projected(points, T_world_cam)
        agree = ahead & (np.linalg.norm(projected - pixels, axis=1) < self.settings.pose.max_reprojection_px)
        if agree.sum() < MIN_INLIERS:
            return None
        return _Solution(T_world_cam, corners[agree], landmarks[agree], float(agree.mean()))

    def _measured(self, image: LocalFeatures, solution: _Solution, shown: BoolArray) -> PoseMeasurement | None:
        """The estimate of a solution, in the given frame; None where its inliers do not determine it."""
        T_world_cam, pixels = solution.T_world_cam, image.pixels[solution.corners]
        points = self.points_xyz[solution.landmarks].astype(np.float64)
        sigmas = self._spreads(pixels, points, T_world_cam[:3, :3], T_world_cam[:3, 3])
        if sigmas is None:
            return None
        T_world_pose = T_world_cam @ np.linalg.inv(self.T_pose_cam)
        off, scatter, apart = self._correction(T_world_pose, shown)
        sigma_m, sigma_rad = np.hypot(sigmas, scatter).tolist()
        turn = Rotation.from_rotvec(-off[3:]) * trusted_rotation(T_world_pose[:3, :3])
        position, quat = self.origin_xyz + T_world_pose[:3, 3] - off[:3], turn.as_quat(scalar_first=True)
        inliers = np.unique(solution.corners)
        shares = solution.inlier_share, self._share_of_image(image.pixels[inliers])
        view = LandmarkView(solution.corners, solution.landmarks, T_world_cam)
        return PoseMeasurement(position, quat, sigma_m, sigma_rad, len(inliers), 1.0, *shares, apart, view)

    def _guided(self, image: LocalFeatures, T_world_cam: FloatArray, shown: BoolArray) -> tuple[IntArray, IntArray]:
        """Corners and landmarks (m,) that match where the keyframes nearest to a pose say that they are."""
        order = np.argsort(np.where(shown, self._apart(T_world_cam @ np.linalg.inv(self.T_pose_cam)), np.inf))
        settings = self.settings.pose
        near = self._spread(order[: min(settings.n_considered, int(shown.sum()))], settings.n_guiding)
        landmarks = np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in near.tolist()])
        pixels_seen, ahead = self._projected(self.points_xyz[landmarks].astype(np.float64), T_world_cam)
        landmarks, pixels_seen = landmarks[ahead], pixels_seen[ahead]
        nearest = np.arange(1, min(settings.n_corners, len(image.pixels)) + 1)
        away, corners = KDTree(image.pixels).query(pixels_seen, nearest, distance_upper_bound=settings.radius_px)
        rows, columns = np.nonzero(np.isfinite(away))
        corners = np.asarray(corners)[rows, columns]
        alike, enough = similar_enough(image.descriptors[corners], self.descriptors[landmarks[rows]])
        best = _most_similar(rows, alike)
        best = best[enough[best]]
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
        x, y = (pixels - pixels.mean(axis=0)).T
        determinant = float((x @ x) * (y @ y) - (x @ y) ** 2) / (len(pixels) - 1) ** 2  # of the covariance
        area = 12 * np.sqrt(max(determinant, 0.0))
        return float(area / (self.camera.width * self.camera.height))

    def _correction(self, T_world_pose: FloatArray, shown: BoolArray) -> tuple[FloatArray, FloatArray, float]:
        """Deviations of nearby keyframes: mean (6,), scatter per axis (2,) in m and rad, and the least distance."""
        apart = self._apart(T_world_pose)
        away = float(apart[shown].min())
        corrected = np.flatnonzero(shown & np.isfinite(self.corrections).all(axis=1))
        if corrected.size == 0:
            return np.zeros(6), np.zeros(2), away
        settings = self.settings.pose
        nearest = corrected[np.argsort(apart[corrected], kind="stable")[: settings.n_corrected_by]]
        corrections, weights = self.corrections[nearest], 1 / (apart[nearest] + settings.min_distance)
        weights /= weights.sum()
        mean = weights @ corrections
        variance = weights @ (corrections - mean) ** 2
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
        least = 2 * self.settings.pose.min_residual_px / (self.camera.fx + self.camera.fy)
        residual = max(float(np.median(off)) / MEDIAN_OF_NORM2, least)
        # derivatives of points on the plane by the camera's motion, along and about its axes
        (x, y), inverse = plane.T, 1 / depth
        slopes = np.zeros((2, len(points), 6))
        slopes[0, :, 0] = slopes[1, :, 1] = -inverse
        slopes[0, :, 2], slopes[1, :, 2] = x * inverse, y * inverse
        slopes[0, :, 3], slopes[0, :, 4], slopes[0, :, 5] = x * y, -1 - x * x, y
        slopes[1, :, 3], slopes[1, :, 4], slopes[1, :, 5] = 1 + y * y, -x * y, -x
        by_motion = slopes.reshape(-1, 6)
        information = by_motion.T @ by_motion / residual**2
        if np.linalg.cond(information) > 1e12:
            return None
        variance = np.diag(np.linalg.inv(information))
        return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean()))


def _most_similar(groups: IntArray, alike: Float32Array) -> IntArray:
    """Indices of the most similar (n,) of each group (n,), numbered from 0."""
    order = np.lexsort((-alike, groups))
    return order[np.flatnonzero(np.diff(groups[order], prepend=-1))]


def _camera_to_world(pose: poselib.CameraPose) -> FloatArray:
    R_world_cam = np.asarray(pose.R).T
    return rigid_motions(R_world_cam, -R_world_cam @ np.asarray(pose.t))
