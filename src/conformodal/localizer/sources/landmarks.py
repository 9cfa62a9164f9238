"""The pose source by PnP on landmarks, and the error model that it learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import ClassVar, Self

import numpy as np

from conformodal.core.arrays import IntArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.core.progress import Progress, stage_of
from conformodal.features.backbone import at_unit_length
from conformodal.features.local import LocalFeatures, Matcher
from conformodal.geometry import PinholeCamera, Trajectory, angle_between_quats
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.measurement import ErrorModel, HeldOutErrors, PoseMeasurement, fit_error_model
from conformodal.localizer.settings import ERROR_MODEL, MAPPING, PNP

from .keyframes import LandmarkMap
from .mapping import build_map, view_overlap
from .registry import SourceAnswer, SourceData, SourceState, register_source

_MAPPED = ("T_pose_cam", "shutter", "poses_se3", "global_descriptors", "starts", "points_xyz")
_ARRAYS = (*_MAPPED, "descriptors", "corrections")


@register_source
@dataclass(frozen=True, eq=False)
class LandmarkSource:
    """A map of landmarks from `frames` (m,), or 1000 of them, and the error model of its estimates."""

    name: ClassVar[str] = "landmarks"
    local: ClassVar[bool] = True

    map: LandmarkMap
    frames: IntArray
    errors: ErrorModel
    grid: tuple[int, int] | None = None  # of the network's map, which retrieves places; None: thumbnails do

    @property
    def summary(self) -> dict[str, float]:
        """Counts and focal length, for records and messages."""
        return {
            "n_keyframes": len(self.map.poses_se3),
            "n_landmarks": len(self.map.points_xyz),
            "focal_px": round(self.map.camera.fx, 2),
        }

    @classmethod
    def fit(cls, data: SourceData, frames: IntArray) -> Self | None:
        """Map the frames; None where the scene's depth is not known, or too few frames can be localised."""
        if not np.isfinite(data.depth_m) or len(frames) < ERROR_MODEL.least_estimates:
            return None
        pieces = data.stretches if len(np.unique(data.pieces[frames])) < 2 else data.pieces
        chosen = frames[evenly_spread(len(frames), MAPPING.max_keyframes)]
        source = cls.of(
            data.local_features(chosen),
            data.sequence.require_truth()[chosen],
            (pieces[chosen], data.stretches[chosen]),
            data.sequence.camera,
            data.depth_m,
            frames,
            stage_of(data.progress, "landmarks"),
            data.matcher,
        )
        return None if source is None else replace(source, grid=data.grid)

    @classmethod
    def of(
        cls,
        features: Sequence[LocalFeatures],
        truth: Trajectory,
        groups: Sequence[IntArray],
        camera: PinholeCamera,
        depth_m: float,
        frames: IntArray,
        progress: Progress | None = None,
        matcher: Matcher | None = None,
    ) -> Self | None:
        """Map n images with known poses, and learn the error model by hiding images from the map.

        Each of `groups` labels the images (n,): those with the label of a left-out image are hidden with it.
        """
        n = len(features)
        left_out = evenly_spread(n, MAPPING.left_out)
        total = n + len(left_out)

        def done(before: int) -> Progress | None:
            return None if progress is None else lambda count, _: progress(before + count, total)

        landmarks = build_map(features, truth.poses_se3, camera, depth_m, done(0), matcher)
        errors = _fit_errors(landmarks, features, truth, groups, left_out, done(n))
        return None if errors is None else cls(landmarks, frames, errors)

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """One estimate per retrieval cluster; none for images without local features."""
        images = evidence.local_features
        if not images:
            return SourceAnswer(measurements=[[] for _ in evidence.features])
        if self.grid is not None:
            rows = zip(images, at_unit_length(evidence.coarse(self.grid)), strict=True)
            images = [image._replace(global_descriptor=row) for image, row in rows]
        return SourceAnswer(measurements=in_threads(self.localize, images))

    def localize(self, image: LocalFeatures) -> list[PoseMeasurement]:
        """Estimates of one image whose standard deviation is below half the scene's depth."""
        estimates = (self.errors.apply(one, *_support(one)) for one in self.map.localize(image))
        return [one for one in estimates if one.sigma_m < PNP.same_place * self.map.depth_m]

    def state(self) -> SourceState:
        """The map's arrays and camera, and the errors."""
        arrays = {"frames": self.frames, **{k: getattr(self.map, k) for k in _ARRAYS}}
        settings = {"camera": asdict(self.map.camera), "depth_m": self.map.depth_m, "errors": asdict(self.errors)}
        settings["grid"] = self.grid
        return SourceState(arrays, settings)

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored."""
        settings = state.settings
        arrays = {k: state.arrays[k] for k in _ARRAYS}
        mapped = LandmarkMap(camera=PinholeCamera(**settings["camera"]), depth_m=float(settings["depth_m"]), **arrays)
        grid = None if settings["grid"] is None else tuple(settings["grid"])
        return cls(mapped, state.arrays["frames"], ErrorModel.from_json(settings["errors"]), grid)


def _fit_errors(
    landmarks: LandmarkMap,
    features: Sequence[LocalFeatures],
    truth: Trajectory,
    groups: Sequence[IntArray],
    left_out: IntArray,
    progress: Progress | None,
) -> ErrorModel | None:
    """Fit the error model to frames localised with their piece, stretch or surroundings hidden from the map."""

    def estimated(i: int) -> list[tuple[float, ...]]:
        rows: list[tuple[float, ...]] = []
        matches: dict[int, IntArray] = {}
        overlap = view_overlap(landmarks.poses_se3, i, landmarks.camera, landmarks.depth_m)
        hidings = [(group == group[i], 1.0) for group in groups]
        hidings += [(overlap > share, MAPPING.hidden_weight) for share in MAPPING.hidden_overlaps]
        for hidden, weight in hidings:
            for one in landmarks.localize(features[i], hidden, matches=matches):
                off = float(np.linalg.norm(one.position_xyz - truth.positions_xyz[i]))
                angle = float(angle_between_quats(one.orientation_quat_wxyz, truth.orientations_quat_wxyz[i]))
                predicted = (off, one.sigma_m, angle, one.sigma_rad, one.distance_to_known)
                rows.append((*predicted, weight, *_support(one)))
        return rows

    rows = [row for part in in_threads(estimated, left_out.tolist(), progress) for row in part]
    if len(rows) < ERROR_MODEL.least_estimates:
        return None
    table = np.array(rows)
    off, sigma_m, angle, sigma_rad, distance, weights = table[:, :6].T
    errors = HeldOutErrors(off, sigma_m, angle, sigma_rad, distance, table[:, 6:], weights)
    return fit_error_model(errors, PNP.same_place * landmarks.depth_m)


def _support(one: PoseMeasurement) -> tuple[float, float, float]:
    """Distinct inliers, their share of the matched corners, and the share of the image that they cover."""
    return float(max(one.n_inliers, 1)), max(one.inlier_share, 1e-3), max(one.image_share, 1e-3)
