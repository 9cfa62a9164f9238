"""The pose source by landmarks: a map of them, and the learnt errors of its estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.core.progress import Progress, stage_of
from conformodal.core.ranges import Range
from conformodal.core.schema import ArraySpec
from conformodal.features.backbone import at_unit_length
from conformodal.features.local import LocalFeatures
from conformodal.geometry import PinholeCamera, Trajectory, angle_between_quats
from conformodal.geometry.camera import CAMERA_JSON
from conformodal.geometry.poses import rotation_faults
from conformodal.io import THUMBNAIL
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import (
    MIN_ESTIMATES,
    ErrorModel,
    FrameEvidence,
    HeldOutErrors,
    LandmarkView,
    PoseMeasurement,
    fit_error_model,
)
from conformodal.localizer.landmark_settings import LandmarkSettings
from conformodal.localizer.training_data import TrainingData

from .landmark_map import LandmarkMap
from .registry import SourceAnswer, SourceState, register_source

_ARRAYS = {
    "T_pose_cam": ArraySpec("d", (4, 4)),
    "shutter": ArraySpec("d", (2,)),
    "origin_xyz": ArraySpec("d", (3,)),
    "poses_se3": ArraySpec("d", ("n_keyframes", 4, 4)),
    "global_descriptors": ArraySpec("e", ("n_keyframes", "n_coarse")),
    "starts": ArraySpec("lq", ("n_starts",)),
    "points_xyz": ArraySpec("f", ("n_landmarks", 3)),
    "descriptors": ArraySpec("Bb", ("n_landmarks", "n_bytes"), "anything"),
    "corrections": ArraySpec("d", ("n_keyframes", 6), "finite or NaN"),
}
_HELD_OUT = {"held_out": ArraySpec("d", ("n_held_out?", 9))}
_SETTINGS = {
    "camera": CAMERA_JSON,
    "depth_m": Range(0, 1e9, "(]"),
    "errors": ErrorModel.json_schema(n_support=3),
    "grid": (None, [Range(1, whole=True)] * 2),
}


@register_source
@dataclass(frozen=True, eq=False)
class LandmarkSource:
    """A map of landmarks from keyframes of `frames` (m,), and the error model of its estimates."""

    name: ClassVar[str] = "landmarks"
    local: ClassVar[bool] = True
    least_sigma_m: ClassVar[float] = 0.0  # it is always asked

    map: LandmarkMap
    frames: IntArray
    errors: ErrorModel
    # of the network's map, which retrieves places; None: the detector's description of the image does, or a thumbnail
    grid: tuple[int, int] | None = None
    # (m, 9) estimates of left-out keyframes, from which the errors were learnt: error and sigma in metres and radians,
    # distance to the nearest keyframe, weight, and what supports each
    held_out: FloatArray = field(default_factory=lambda: np.empty((0, 9)))

    @property
    def carries(self) -> bool:
        """Whether it needs no network to retrieve places: with one, detecting features is not what takes longest."""
        return self.grid is None

    @property
    def summary(self) -> dict[str, float]:
        """Counts and focal length, for records and messages."""
        return {
            "n_keyframes": len(self.map.poses_se3),
            "n_landmarks": len(self.map.points_xyz),
            "focal_px": round(self.map.camera.fx, 2),
        }

    @classmethod
    def fit(cls, data: TrainingData, frames: IntArray) -> Self | None:
        """Map the frames; None where the scene's depth is not known, or too few frames can be localised."""
        if not np.isfinite(data.depth.median_m) or len(frames) < MIN_ESTIMATES:
            return None
        pieces = data.stretches if len(np.unique(data.pieces[frames])) < 2 else data.pieces
        truth = data.sequence.require_truth()
        settings = data.settings.landmarks
        chosen = frames[_keyframes(truth[frames].poses_se3, data.depth.median_m, settings)]
        features, truth = data.local_features(chosen), truth[chosen]
        left_out, report = evenly_spread(len(chosen), settings.n_left_out), stage_of(data.progress, "landmarks")

        def done(before: int) -> Progress | None:
            return None if report is None else lambda n, _: report(before + n, len(chosen) + len(left_out))

        camera, depth_m, matcher = data.sequence.camera, data.depth.median_m, data.computed.matcher
        landmarks = LandmarkMap.build(features, truth.poses_se3, camera, depth_m, done(0), matcher, settings)
        groups = pieces[chosen], data.stretches[chosen]
        held_out = _held_out_errors(landmarks, features, truth, groups, left_out, done(len(chosen)))
        errors = _fit_errors(held_out, landmarks)
        grid = None if data.detector.describes_images else data.grid
        return None if errors is None else cls(landmarks, frames, errors, grid, held_out)

    def extended(self, data: TrainingData, numbers: IntArray, *, learn_errors: bool = True) -> Self:
        """With all frames of other data, whose `numbers` (n,) among the known frames are larger than the known ones.

        Errors are learnt from those of earlier frames and of some of these, estimated with their whole recording, their
        stretch or their surroundings hidden; without `learn_errors` they stay as they were.
        """
        every, whole = data.sequence.require_truth(), np.arange(len(numbers))
        settings = self.map.settings
        chosen = whole[_keyframes(every.poses_se3, self.map.depth_m, settings)]
        left_out = evenly_spread(len(chosen), settings.n_left_out if learn_errors else 0)
        report = stage_of(data.progress, "landmarks")

        def done(before: int) -> Progress | None:
            return None if report is None else lambda n, _: report(before + n, len(chosen) + len(left_out))

        features, truth = data.local_features(chosen), every[chosen]
        mapped = self.map.extended(features, truth.poses_se3, done(0))
        grown = replace(self, map=mapped, frames=np.concatenate((self.frames, numbers)))
        if not learn_errors:
            return grown
        groups = np.zeros(len(chosen), dtype=np.int64), data.stretches[chosen]
        added = _held_out_errors(mapped, features, truth, groups, left_out, done(len(chosen)))
        held_out = np.concatenate((self.held_out, added))
        return replace(grown, errors=_fit_errors(held_out, mapped) or self.errors, held_out=held_out)

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """At most one estimate per retrieval cluster; none for images without local features."""
        images = evidence.local_features
        if not images:
            return SourceAnswer(measurements=[[] for _ in range(len(evidence))])
        told = evidence.estimates or [None] * len(images)
        missing = np.flatnonzero([one is None for one in told])
        images = [images[i] for i in missing.tolist()]
        if self.grid is not None and images:
            rows = zip(images, at_unit_length(evidence.coarse(self.grid))[missing], strict=True)
            images = [image._replace(global_descriptor=row) for image, row in rows]
        answers = iter(in_threads(self.localize, images))
        return SourceAnswer(measurements=[_without_views(next(answers)) if one is None else one for one in told])

    def turn_for(self, position_xyz: FloatArray, quat_wxyz: FloatArray) -> float:
        """See :meth:`~conformodal.localizer.sources.landmark_map.LandmarkMap.turn_for`."""
        return self.map.turn_for(position_xyz, quat_wxyz)

    def carry(
        self, image: LocalFeatures, view: LandmarkView, detected: PoseMeasurement, n_followed: int
    ) -> PoseMeasurement | None:
        """The estimate of an image into which corners of the one before were followed; see :class:`CarriesLandmarks`.

        Its place is as strongly recognised as when the corners were detected, but less probable, the fewer still agree.
        """
        one = self.map.carry(image, view)
        if one is None:
            return None
        share = detected.inlier_share * one.n_inliers / n_followed
        one = replace(one, n_inliers=detected.n_inliers, image_share=detected.image_share, inlier_share=share)
        return next(iter(self._precise([self.errors.apply(one, *_support(one))])), None)

    def localize(self, image: LocalFeatures) -> list[PoseMeasurement]:
        """Estimates of one image whose standard deviation is below half the scene's depth."""
        return self._precise([self.errors.apply(one, *_support(one)) for one in self.map.localize(image)])

    def _precise(self, estimates: list[PoseMeasurement]) -> list[PoseMeasurement]:
        most_m = self.map.settings.same_place_depths * self.map.depth_m
        return [one for one in estimates if one.sigma_m < most_m]

    def state(self) -> SourceState:
        """The map's arrays and camera, and the errors; refused where a loaded source would answer differently."""
        own, usual = self.map.settings, LandmarkSettings()
        if (own.pose, own.same_place_depths) != (usual.pose, usual.same_place_depths):
            raise LocalizationError("a map that localises with other settings than the defaults cannot be stored")
        arrays = {"frames": self.frames, "held_out": self.held_out, **{k: getattr(self.map, k) for k in _ARRAYS}}
        settings = {"camera": asdict(self.map.camera), "depth_m": self.map.depth_m, "errors": asdict(self.errors)}
        return SourceState(arrays, {**settings, "grid": self.grid})

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored."""
        settings, grid = state.settings, state.settings.get("grid")
        thumbnails = {"n_coarse": THUMBNAIL[0] * THUMBNAIL[1]} if grid is None else {}
        replace(state, sizes=state.sizes | thumbnails).check(_ARRAYS | _HELD_OUT, _SETTINGS)
        arrays = {k: state.arrays[k] for k in _ARRAYS}
        if grid is not None and grid != [state.sizes.get("n_rows", grid[0]), state.sizes.get("n_columns", grid[1])]:
            raise LocalizationError(f"settings.grid is {grid}, another one than that of the network")
        starts, n = arrays["starts"], [len(arrays[name]) for name in ("poses_se3", "points_xyz")]
        if len(starts) != n[0] + 1 or starts[0] != 0 or starts[-1] != n[1] or (np.diff(starts) < 0).any():
            raise LocalizationError(f"array starts must lead {n[0]} keyframes from 0 to {n[1]} landmarks")
        for name in ("poses_se3", "T_pose_cam"):
            motions = arrays[name].reshape(-1, 4, 4)
            if rotation_faults(motions[:, :3, :3]) or not np.allclose(motions[:, 3], (0, 0, 0, 1)):
                raise LocalizationError(f"array {name} must hold rigid motions")
        mapped = LandmarkMap(
            camera=PinholeCamera(**settings["camera"]),
            depth_m=float(settings["depth_m"]),
            settings=LandmarkSettings(),
            **arrays,
        )
        grid = None if grid is None else tuple(grid)
        return cls(
            mapped, state.arrays["frames"], ErrorModel.from_json(settings["errors"]), grid, state.arrays["held_out"]
        )


def _keyframes(poses_se3: FloatArray, depth_m: float, settings: LandmarkSettings) -> IntArray:
    """Of frames with poses (n, 4, 4), those whose view differs from that of the keyframe before, in order.

    Of each area, at most `max_keyframes` that are evenly spread over it; the first keyframe that is in no area is the
    middle of the next.
    """
    left, positions = _distinct_views(poses_se3, depth_m, settings.keyframe_step), poses_se3[:, :3, 3]
    chosen = list[IntArray]()
    while left.size:
        near = np.linalg.norm(positions[left] - positions[left[0]], axis=1) < settings.area_depths * depth_m
        area, left = left[near], left[~near]
        chosen.append(area[evenly_spread(len(area), settings.max_keyframes)])
    return np.sort(np.concatenate(chosen))


def _distinct_views(poses_se3: FloatArray, depth_m: float, step: float) -> IntArray:
    """Of frames with poses (n, 4, 4), the first, and each that is a step away from the one chosen before."""
    chosen, positions, axes = [0], poses_se3[:, :3, 3] / depth_m, poses_se3[:, :3, :3]
    for i in range(1, len(poses_se3)):
        turn = np.arccos(np.clip((np.sum(axes[i] * axes[chosen[-1]]) - 1) / 2, -1, 1))
        if turn + np.linalg.norm(positions[i] - positions[chosen[-1]]) > step:
            chosen.append(i)
    return np.array(chosen)


def _held_out_errors(
    landmarks: LandmarkMap,
    features: Sequence[LocalFeatures],
    truth: Trajectory,
    groups: Sequence[IntArray],
    left_out: IntArray,
    progress: Progress | None,
) -> FloatArray:
    """Estimates (m, 9) of some keyframes with their piece, stretch or surroundings hidden, see the class above.

    `features`, `truth` and each of `groups` are of the last n keyframes, `left_out` of these: those with the label of a
    left-out keyframe are hidden with it.
    """
    from .mapping import view_overlap  # noqa: PLC0415 - only learning needs it

    n_before, settings = len(landmarks.poses_se3) - len(features), landmarks.settings

    def estimated(i: int) -> list[tuple[float, ...]]:
        rows: list[tuple[float, ...]] = []
        matches: dict[int, IntArray] = {}
        overlap = view_overlap(landmarks.poses_se3, n_before + i, landmarks.camera, landmarks.depth_m)
        earlier = np.zeros(n_before, dtype=np.bool_)
        hidings = [(np.concatenate((earlier, group == group[i])), 1.0) for group in groups]
        hidings += [(overlap > share, settings.hidden_weight) for share in settings.hidden_overlaps]
        estimates: dict[bytes, list[PoseMeasurement]] = {}  # pieces may be stretches
        for hidden, weight in hidings:
            key = hidden.tobytes()
            if key not in estimates:
                estimates[key] = landmarks.localize(features[i], hidden, matches=matches)
            for one in estimates[key]:
                off = float(np.linalg.norm(one.position_xyz - truth.positions_xyz[i]))
                angle = float(angle_between_quats(one.orientation_quat_wxyz, truth.orientations_quat_wxyz[i]))
                predicted = (off, one.sigma_m, angle, one.sigma_rad, one.distance_to_known)
                rows.append((*predicted, weight, *_support(one)))
        return rows

    rows = [row for part in in_threads(estimated, left_out.tolist(), progress) for row in part]
    return np.array(rows).reshape(-1, 9)


def _fit_errors(held_out: FloatArray, landmarks: LandmarkMap) -> ErrorModel | None:
    """The error model of estimates (m, 9), see :attr:`LandmarkSource.held_out`; None of too few."""
    if len(held_out) < MIN_ESTIMATES:
        return None
    off, sigma_m, angle, sigma_rad, distance, weights = held_out[:, :6].T
    errors = HeldOutErrors(off, sigma_m, angle, sigma_rad, distance, held_out[:, 6:], weights)
    return fit_error_model(errors, landmarks.settings.same_place_depths * landmarks.depth_m)


def _support(one: PoseMeasurement) -> tuple[float, float, float]:
    """Distinct inliers, their share of the matched corners, and the share of the image that they cover."""
    return float(max(one.n_inliers, 1)), max(one.inlier_share, 1e-3), max(one.image_share, 1e-3)


def _without_views(estimates: list[PoseMeasurement]) -> list[PoseMeasurement]:
    """The estimates alone, as they are stored for as long as a run takes."""
    return [replace(one, view=None) for one in estimates]
