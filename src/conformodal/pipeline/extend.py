"""Extending a model by recordings that came later: each is a test before it is taught.

A recording is answered as a stream by the model that has not seen it. Its scores join the calibration, then its frames
join the map and the other sources that can learn from what the model stores. Images of earlier recordings are not
needed. A recording without poses joins the sources alone, with the frames of which the model is sure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from conformodal.conformal import NoveltyTest, SplitConformal
from conformodal.core.arrays import Float32Array, FloatArray, IntArray, RealArray, UInt8Array
from conformodal.core.parallel import raise_if_cancelled
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.local import LocalFeatures
from conformodal.geometry import RelativeMotion, concatenate, pose_targets, trajectory_errors
from conformodal.io import Recording, Split
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import hindsight_posteriors
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import Observations, Posterior
from conformodal.localizer.regions import PlaceNovelty, RegionRules
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.sources.growing import GrowsWithFrames
from conformodal.localizer.training_data import TrainingData
from conformodal.tracking.depths import SceneDepth
from conformodal.tracking.tracker import ImageCorners

from .calibrate_paths import PathScores, make_path_rule
from .config import Method, OdometryError
from .estimates import Estimate
from .estimator import VisualOdometry
from .identity import FrameIdentities, identify
from .model import HINDSIGHT, ONLINE, JournalEntry, Localization, PathRule, PoseModel
from .own_poses import answer_reliably
from .stream_scores import StreamScores
from .whole_recordings import calibrate_by_recordings

ASSUMPTION = (
    "This assumes that the recordings that joined are exchangeable in the order in which they came. Each was judged by "
    "a smaller map than the one at the end: thresholds are too large rather than too small where more map helps."
)
_MAX_BEYOND = 0.5  # share of a recording's poses that may lie beyond the cells of the model


def extend_model(
    model: PoseModel,
    recordings: Sequence[Recording],
    *,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
) -> PoseModel:
    """Extend a model by recordings, one after another, in the order in which they came.

    The thresholds rest on the assumption that the recordings are exchangeable, and that the scores of each, under the
    smaller map before it, are no smaller than they would be under the map at the end. Head, motion prior and cells
    stay as they were learnt.

    Parameters
    ----------
    model
        One that stretches or recordings calibrate.
    recordings
        From the model's camera, with a pose in its world frame for every frame, or for none: then reliable frames join
        the map at the model's own answers, and nothing calibrates. None of its images may be in the model.
    cache
        Where features of the network are kept; by default they are not.
    progress
        Called with stage, parts done and parts in all.

    Raises
    ------
    OdometryError
        If the model or a recording cannot be used; it names them.
    """
    cache = FeatureCache(None) if cache is None else cache
    for recording in recordings:
        extended = _extended if len(recording.posed) else _extended_by_own_poses
        model = extended(model, recording, cache, progress)
    return model


def check_extension(model: PoseModel, recording: Recording) -> FrameIdentities:
    """The identities of a recording's frames; refuses a recording that cannot extend the model, or twice."""
    name = recording.name
    if model.method is Method.PAPER:
        raise OdometryError("the model was trained with the paper's method, which cannot be extended")
    if not model.follows_streams:
        raise OdometryError("random frames calibrate the model; train with --split blocks or recordings to extend it")
    if (n := len(np.unique(recording.recording))) > 1:
        raise OdometryError(f"{name}: holds {n} recordings; give the folder of each, in the order in which they came")
    n_posed = len(recording.posed)
    if 0 < n_posed < len(recording):
        n_without = counted(len(recording) - n_posed, "frame")
        raise OdometryError(f"{name}: {n_without} without a pose; a recording needs one for each, or none at all")
    model.check_unit(recording)
    try:
        model.check_camera(recording.camera)
    except OdometryError as exc:
        raise OdometryError(f"{name}: is from another camera: {exc}") from None
    frames = identify(recording)
    if n := int(model.known_frames.known(frames).sum()):
        raise OdometryError(f"{name}: {n} of its {counted(len(recording), 'image')} are in the model already")
    if recording.truth is None:
        return frames
    targets = pose_targets(recording.truth, model.sign_reference)
    beyond = (model.localizer.cells.encode(targets) < 0).any(axis=1)
    if beyond.mean() > _MAX_BEYOND:
        raise OdometryError(
            f"{name}: {beyond.sum()} of {counted(len(recording), 'pose')} lie far beyond those of the model; "
            "train on all recordings together"
        )
    return frames


def _extended(model: PoseModel, recording: Recording, cache: FeatureCache, progress: StageProgress | None) -> PoseModel:
    frames = check_extension(model, recording)
    n, n_known = len(recording), len(model.known_frames)
    numbers = np.arange(n_known, n_known + n)
    data = _training_data(model, recording, cache, progress)
    motions = data.run_front_end(np.arange(n), local=model.looks_at_local_features, motions=True)
    estimates = _answered(model, data, motions, progress)
    units = _units_of(model, n)
    entry = _journal_entry(model, recording, estimates, units)
    localizer = _with_frames(model, data, numbers)
    localization = Localization.concatenate([one.localization for one in estimates if one.localization is not None])
    rooms, model = _with_rooms(model, data)
    rules, path_rules = _with_scores(model, data, localization, estimates, units, rooms)
    split = replace(model.split, calibration=np.concatenate((model.split.calibration, numbers)))
    grown = replace(
        model,
        localizer=localizer,
        novelty=_with_references(model, data, localization, estimates, units),
        rules=rules,
        path_rules=path_rules,
        rooms=rooms,
        split=split,
        known_frames=FrameIdentities.concatenate([model.known_frames, frames]),
        configuration={**model.configuration, "n_frames": n_known + n},
        journal=(*model.journal, entry),
    )
    return calibrate_by_recordings(grown)


def _extended_by_own_poses(
    model: PoseModel, recording: Recording, cache: FeatureCache, progress: StageProgress | None
) -> PoseModel:
    """The model whose sources know the reliable frames of a recording without poses; what calibrates stays."""
    frames, n_known = check_extension(model, recording), len(model.known_frames)
    joining = answer_reliably(model, recording, progress)
    data = _training_data(model, joining.recording, cache, progress)
    localizer = _with_frames(model, data, n_known + joining.frames, learn_errors=False)
    rooms, model = _with_rooms(model, data)
    truth = joining.recording.require_truth()
    frames.poses[joining.frames] = np.column_stack((truth.positions_xyz, truth.orientations_quat_wxyz))
    numbers = np.arange(n_known, n_known + len(recording))
    return replace(
        model,
        localizer=localizer,
        rooms=rooms,
        split=replace(model.split, train=np.concatenate((model.split.train, numbers))),
        known_frames=FrameIdentities.concatenate([model.known_frames, frames]),
        configuration={**model.configuration, "n_frames": n_known + len(recording)},
        journal=(*model.journal, joining.entry),
    )


def _with_frames(model: PoseModel, data: TrainingData, numbers: IntArray, *, learn_errors: bool = True) -> Localizer:
    """The localizer whose sources, as far as they can, know all frames of a recording by their numbers (n,)."""
    sources = [
        source.extended(data, numbers, learn_errors=learn_errors) if isinstance(source, GrowsWithFrames) else source
        for source in model.localizer.sources
    ]
    return replace(model.localizer, sources=tuple(sources))


def _training_data(
    model: PoseModel, recording: Recording, cache: FeatureCache, progress: StageProgress | None
) -> TrainingData:
    """A recording with poses, and the features of its images."""
    stage = stage_of(progress, "features")
    features = extract_features(recording.image_paths, model.backbone, cache, stage, recording.noise)
    targets = pose_targets(recording.require_truth(), model.sign_reference)
    return TrainingData(
        recording,
        Split(model.split.kind, model.split.seed, np.arange(len(recording)), *[np.empty(0, dtype=np.int64)] * 2),
        features,
        targets,
        model.sign_reference,
        depth=SceneDepth(model.localizer.depth_m),
        grid=model.backbone.config.grid,
        progress=progress,
        detector=model.detector,
    )


class _Replay(VisualOdometry):
    """A stream of frames in which everything but what depends on the map was measured before."""

    def __init__(self, model: PoseModel, data: TrainingData, motions: dict[int, RelativeMotion | None]) -> None:
        self._data, self._motions, self._frame = data, motions, -1
        super().__init__(model)

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        self._frame += 1
        return super()._answer(image, timestamp_s)

    def _motion(self, grey: UInt8Array, beside: ImageCorners | None) -> RelativeMotion | None:
        return self._motions[self._frame]

    def _features(self, image: UInt8Array) -> Float32Array:
        return self._data.features[self._frame : self._frame + 1]

    def _flow(self, timestamp_s: float) -> FloatArray:
        return self._upright.flow if self.model.looks_at_local_features else super()._flow(timestamp_s)

    def _detect(self, grey: UInt8Array, flow: FloatArray, turn_rad: float) -> Iterator[LocalFeatures | None]:
        return iter((self._upright,)) if turn_rad == 0 else super()._detect(grey, flow, turn_rad)

    @property
    def _upright(self) -> LocalFeatures:
        return self._data.local_features(np.array([self._frame]))[0]


def _answered(
    model: PoseModel, data: TrainingData, motions: dict[int, RelativeMotion | None], progress: StageProgress | None
) -> list[Estimate]:
    """The answers to a recording as a stream, by a model that has not seen it."""
    odometry, estimates, report = _Replay(model, data, motions), list[Estimate](), stage_of(progress, "test")
    for i, time_s in enumerate(data.sequence.timestamps_s.tolist()):
        raise_if_cancelled()
        try:
            estimates.append(odometry.step(data.sequence.image(i), time_s))
        except OdometryError as exc:
            raise OdometryError(f"{data.sequence.name}: {exc}") from None
        if report is not None:
            report(i + 1, len(data.sequence))
    return estimates


def _units_of(model: PoseModel, n: int) -> IntArray:
    """Labels (n,) of the calibration units of a recording of n frames: itself, or stretches as long as the others."""
    labels = model.calibration.units_
    assert labels is not None
    used = [labels, *(rule.calibration.units_ for rule in model.path_rules.values())]
    used += [] if model.novelty is None else [model.novelty.test.units_]
    first = 1 + max(int(each.max(initial=-1)) for each in used if each is not None)
    if model.configuration.get("whole_recordings"):
        return np.full(n, first)
    size = float(np.median(np.unique(labels, return_counts=True)[1]))
    parts = np.array_split(np.arange(n), max(1, round(n / size)))
    return first + np.repeat(np.arange(len(parts)), [len(part) for part in parts])


def _journal_entry(model: PoseModel, recording: Recording, estimates: list[Estimate], units: IntArray) -> JournalEntry:
    """How a recording was answered."""
    truth = recording.require_truth()
    scores = StreamScores(model, truth)
    for i, estimate in enumerate(estimates):
        scores.add(i, estimate, truth[i : i + 1])
    online = concatenate([one.pose.at(one.timestamp_s) for one in estimates if one.pose is not None])
    regions, paths = scores.statistics, scores.path_coverage(online)
    path = None if paths is None else paths.get(ONLINE)
    return JournalEntry(
        name=recording.name,
        date=datetime.now(UTC).date().isoformat(),
        n_frames=len(recording),
        coverage=float(regions.held.mean()),
        bounded=float(regions.bounded.mean()),
        path_coverage=None if path is None else path["coverage"],
        path_bounded=None if path is None else 1 - path["abstained"],
        reliable=float(np.mean([one.reliable for one in estimates])),
        median_m=trajectory_errors(online, truth)["median_m"],
        first_unit=int(units[0]),
        n_units=len(np.unique(units)),
    )


def _with_scores(
    model: PoseModel,
    data: TrainingData,
    localization: Localization,
    estimates: list[Estimate],
    units: IntArray,
    rooms: Rooms | None,
) -> tuple[RegionRules, dict[str, PathRule]]:
    """The calibration with the scores of a recording, by image and by path."""
    rules, beliefs, targets = model.rules, localization.beliefs, data.targets
    supports = model.localizer.supports(beliefs)
    beyond = np.array([support.out_of_range for support in supports])
    known_p = np.where(beyond, 0.0, np.minimum(np.nan_to_num(localization.known_p, nan=1.0), 1.0))  # sums are rounded
    of_image = None if rooms is None else rooms.rooms_of(localization.candidates)
    joined = replace(
        rules,
        overall=_joined(rules.overall, model.scores(beliefs, targets), units),
        recognised=None if rules.recognised is None else np.concatenate((rules.recognised, beliefs.recognised)),
        known_p=np.concatenate((rules.known_p, known_p)),
        rooms=None if of_image is None or rules.rooms is None else np.concatenate((rules.rooms, of_image)),
    )
    if not model.path_rules:
        return joined, {}
    observed = Observations(
        localization.candidates,
        [one.relative_motion for one in estimates],
        data.sequence.timestamps_s,
        known=joined.shows_known_place[-len(units) :],
    )
    forward = [one.posterior for one in estimates if one.posterior is not None]
    posteriors: dict[str, list[Posterior]] = {ONLINE: forward}
    posteriors[HINDSIGHT] = hindsight_posteriors(observed, model.prior, forward)
    path_rules = {}
    for path, before in model.path_rules.items():
        scored = PathScores.of(model.localizer, beliefs, posteriors[path], targets, model.prior, rooms, known_p)
        path_rules[path] = _joined_path(before, make_path_rule(rules, scored, units))
    return joined, path_rules


def _joined(rule: SplitConformal, scores: RealArray, units: IntArray) -> SplitConformal:
    """A rule with more calibration scores (n, 7), of other units (n,)."""
    assert rule.units_ is not None
    every = np.concatenate((rule.scores_, scores.astype(rule.scores_.dtype)))
    return copy(rule).calibrate_scores(every, np.concatenate((rule.units_, units)))


def _joined_path(one: PathRule, other: PathRule) -> PathRule:
    """A rule with the scores of both, of different units."""
    parts = [one.calibration, other.calibration]
    scores, units, sizes = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("scores_", "units_", "unit_sizes_")
    )
    return replace(
        one,
        calibration=copy(one.calibration).calibrate_scores(scores, units, sizes),
        longest_gap_s=max(one.longest_gap_s, other.longest_gap_s),
        squared=np.concatenate((one.squared, other.squared)),
        known_p=np.concatenate((one.known_p, other.known_p)),
        rooms=np.concatenate((one.rooms, other.rooms)),
    )


def _with_references(
    model: PoseModel, data: TrainingData, localization: Localization, estimates: list[Estimate], units: IntArray
) -> PlaceNovelty | None:
    """The novelty test that knows a recording; frames in which corners were detected join those it ranks among."""
    novelty = model.novelty
    if novelty is None:
        return None
    evidence = FrameEvidence(data.features)
    coarse = evidence.coarse(novelty.grid).astype(np.float16)
    references = np.concatenate((novelty.test.references, coarse))
    test = NoveltyTest(references, np.concatenate((novelty.test.units_, units)))
    if novelty.matched is None:
        return replace(novelty, test=test)
    detected = np.array([not one.carried for one in estimates])
    ranked = novelty.ranked(novelty.distances(evidence), localization.beliefs.recognition)[detected]
    scores = np.concatenate((novelty.matched.scores_, ranked))
    matched = test.rescored(scores, np.concatenate((novelty.matched.units_, units[detected])))
    return replace(novelty, test=test, matched=matched)


def _with_rooms(model: PoseModel, data: TrainingData) -> tuple[Rooms | None, PoseModel]:
    """The rooms of the world with a recording, and the model whose calibration has their numbers."""
    if model.rooms is None:
        before = model.known_frames.poses[model.localizer.frames, :3]
        labels = np.zeros(len(before), dtype=np.int64)
    else:
        before, labels = model.rooms.positions_xyz, model.rooms.rooms
    positions = np.concatenate((before, data.targets[:, :3]))
    new = np.full(len(data.targets), labels.max() + 1)
    rooms = Rooms.of(positions, np.concatenate((labels, new)), model.localizer.depth_m)
    if rooms is None:
        single = {path: replace(rule, rooms=np.zeros_like(rule.rooms)) for path, rule in model.path_rules.items()}
        return None, replace(model, rules=replace(model.rules, rooms=None), path_rules=single)
    number = np.array([rooms.rooms[np.flatnonzero(labels == label)[0]] for label in range(labels.max() + 1)])
    of_images = np.zeros(len(model.rules.known_p), np.int64) if model.rules.rooms is None else model.rules.rooms
    rules = replace(model.rules, rooms=number[of_images])
    path_rules = {path: replace(rule, rooms=number[rule.rooms]) for path, rule in model.path_rules.items()}
    return rooms, replace(model, rules=rules, path_rules=path_rules)
