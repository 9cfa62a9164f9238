"""Adding recordings to a trained model, without the images that it was trained on."""

from __future__ import annotations

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from conformodal.conformal import SplitConformal
from conformodal.core.arrays import IntArray
from conformodal.core.parallel import side_by_side
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory, angle_between_quats
from conformodal.io import DatasetWarning, Recording, Split, SplitKind, make_split
from conformodal.localizer.overlap import overlap_with
from conformodal.localizer.prior import fit_motion_prior
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.sources.source_data import SourceData
from conformodal.localizer.targets import pose_targets
from conformodal.tracking.motions import measure_motions

from .calibrate import Calibrated, calibrate_disturbed, calibrate_paths, calibrate_regions, compare_sources
from .config import Method, ModelConfig, config_of
from .errors import OdometryError
from .folds import make_added_folds
from .identity import FrameIdentities, identify
from .model import PoseModel

_LEAST_BLOCKS = 5
_SAME_M, _SAME_RAD = 1e-3, 2e-3  # of one pose
_LEAST_COPIED, _NEARLY_ALL = 10, 0.9  # different poses, and the share of the frames, that make a copy


def extend_model(
    model: PoseModel,
    sequence: Recording,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
    *,
    check_world: bool = True,
) -> PoseModel:
    """A model that knows the recordings of a sequence beside those that it was trained on.

    The map gets new keyframes, the neighbours and the novelty test new frames; heads, error models and significance
    level stay. Frames are held out as in training. The regions are calibrated on the earlier scores and on those of
    the new recordings, whose stretches (or recordings, or frames) are answered by sources that know all but these.
    Thresholds are no smaller than those of the new recordings alone. The earlier scores are of sources that knew less,
    so the guarantee needs that more frames do not make scores of the earlier places larger. A radius is dropped.

    The given model is not changed. The recordings have poses, in its world frame, and its camera. With `check_world`
    world frames are compared where the map recognises images; turn it off for places that look alike.

    Raises
    ------
    OdometryError
        If the camera or the world frame is another one, a frame is known already, or the model is of the paper's
        system, whose only source is a head.
    PoseError
        If the sequence has no poses.
    SplitError
        If it has too few frames for its parts.
    """
    truth, first = sequence.require_truth(), len(model.known_frames)
    config = replace(config_of(model.settings), joint=model.rules.overall.joint, novelty_level=float(model.rules.level))
    if model.method is Method.PAPER or model.novelty is None:
        raise OdometryError("the model has no novelty test to extend (the paper's system has none): train again")
    model.check_camera(sequence.camera)
    new = identify(sequence, model.known_frames)
    _check_new(model, sequence, new)
    _warn_of_copies(model, sequence)
    n_blocks = _n_blocks(model, sequence)
    split = _split(sequence, config, n_blocks, frames_calibrate=model.calibration.groups_ is None)
    cache, stage = cache or FeatureCache(None), stage_of(progress, "features")
    features = extract_features(sequence.image_paths, model.backbone, cache, stage, sequence.noise)
    data = SourceData(
        sequence,
        features,
        pose_targets(truth, model.sign_reference),
        model.sign_reference,
        split.kind,
        margin=config.margin,
        grid=model.novelty.grid,
        progress=progress,
    )
    if check_world and model.landmarks is not None:
        _check_world(model, model.landmarks, data)
    folds = make_added_folds(sequence, split, model, n_blocks)
    # where frames calibrate, the sources of the only fold are the model's own
    parts = [] if folds.units is None else [fold.train for fold in folds.folds]
    (*localizers, localizer), record = side_by_side(
        lambda: model.localizer.extended(data, [*parts, folds.region_frames], first),
        lambda: measure_motions(sequence, np.sort(folds.held_out), progress, local=False),
    )
    localizers = localizers or [localizer]
    novelty = model.novelty.extended(features[folds.region_frames], folds.pieces[folds.region_frames])
    new_rules = calibrate_regions(data, folds, localizers, novelty, config, (model.rules, localizer.cells))
    own, together = _pooled(model, new_rules)
    known = FrameIdentities.concatenate([model.known_frames, new])
    whole = model.split.joined(split, first)
    learnt = fit_motion_prior(truth[folds.region_frames], sequence.recording[folds.region_frames])
    extent = np.ptp(known.poses[whole.train, :3], axis=0)
    prior = model.prior.widened(learnt, float(np.prod(np.maximum(extent, 1e-3))))
    paths, reliable_p = calibrate_paths(sequence, data.targets, folds, localizers, own, prior, record.motions)
    disturbed, quality = calibrate_disturbed(
        data, model.backbone, cache, folds, localizers, own, progress, (model.rules, model.quality)
    )
    rules = replace(together.rules, disturbed=disturbed.rules.disturbed, disturbed_p=disturbed.rules.disturbed_p)
    assert together.novelty is not None
    assert disturbed.novelty is not None
    novelty = replace(together.novelty, disturbed=disturbed.novelty.disturbed)
    compared = folds.units is not None and len(split.test) > 0
    now = {
        "data": f"{model.configuration['data']} + {sequence.name}",
        "n_frames": first + len(sequence),
        "extended": int(model.configuration.get("extended", 0)) + 1,
    }
    return replace(
        model,
        localizer=localizer,
        novelty=novelty,
        rules=rules,
        prior=prior,
        split=whole,
        known_frames=known,
        configuration={**model.configuration, **now},
        radius=None,
        comparison=compare_sources(data, localizers, localizer, novelty, rules, split.test) if compared else None,
        path_rules={path: _both(rule, paths[path]) for path, rule in model.path_rules.items() if path in paths},
        reliable_p=max(model.reliable_p, reliable_p),
        quality=quality,
    )


def _check_new(model: PoseModel, sequence: Recording, new: FrameIdentities) -> None:
    """Refuse frames that the model knows.

    Raises
    ------
    OdometryError
        For the first of them.
    """
    again = model.known_frames.known(new)
    if again.any():
        raise OdometryError(
            f"{sequence.image_paths[int(again.argmax())]}: has the pixels of a frame that the model knows, and so have "
            f"{again.sum()} of {counted(len(again), 'frame')}; add recordings that it does not know"
        )


def _warn_of_copies(model: PoseModel, sequence: Recording) -> None:
    """Warn if nearly all frames have poses of known ones: a recording that was encoded again is not new."""
    truth, known = sequence.require_truth(), model.known_frames.poses
    apart_m, nearest = cKDTree(known[:, :3]).query(truth.positions_xyz)
    at = np.asarray(nearest, dtype=np.int64)
    same = (apart_m < _SAME_M) & (angle_between_quats(truth.orientations_quat_wxyz, known[at, 3:]) < _SAME_RAD)
    if same.mean() >= _NEARLY_ALL and len(np.unique(at[same])) >= _LEAST_COPIED:
        warnings.warn(
            f"{sequence.name}: {same.sum()} of {counted(len(sequence), 'frame')} have poses of frames that the model "
            "knows: is it a copy, encoded again? Coverage is guaranteed with new recordings only",
            DatasetWarning,
            stacklevel=3,
        )


def _check_world(model: PoseModel, landmarks: LandmarkSource, data: SourceData) -> None:
    """Refuse poses in another world frame.

    Raises
    ------
    OdometryError
        If images that the map recognises agree on one motion between the frames.
    """
    poses = model.known_frames.poses[landmarks.frames]
    views = Trajectory(np.arange(len(poses), dtype=np.float64), poses[:, :3], poses[:, 3:])
    overlap = overlap_with(landmarks.map, views, data.sequence, data.local_features)
    if overlap.moved:
        raise OdometryError(overlap.describe("the model's recordings", data.sequence.name))


def _split(sequence: Recording, config: ModelConfig, n_blocks: int, *, frames_calibrate: bool) -> Split:
    """Parts as in training; recordings are added whole where whole ones were held out, unless their frames calibrate.

    Frames that the data set names for testing stay out where its lists held out frames before.
    """
    by_recording = config.split in (SplitKind.RECORDINGS, SplitKind.GIVEN)
    if by_recording and not frames_calibrate:
        test = np.zeros(len(sequence), dtype=bool)
        if config.split is SplitKind.GIVEN and sequence.given_test is not None:
            test = sequence.given_test
        return Split(config.split, config.seed, np.flatnonzero(~test), np.empty(0, np.int64), np.flatnonzero(test))
    return make_split(
        sequence.recording,
        SplitKind.BLOCKS if by_recording else config.split,
        seed=config.seed,
        test=config.test,
        calibration=config.calibration,
        used=config.used,
        n_blocks=n_blocks,
    )


def _n_blocks(model: PoseModel, sequence: Recording) -> int:
    """Stretches of new recordings, which are as long as the earlier ones, but not so few that a part would be empty."""
    groups = model.calibration.groups_
    if groups is None:
        return _LEAST_BLOCKS
    return max(round(len(sequence) / np.median(np.unique(groups, return_counts=True)[1])), _LEAST_BLOCKS)


def _pooled(model: PoseModel, its: Calibrated) -> tuple[Calibrated, Calibrated]:
    """What calibrates the new frames, whose p-values are among all frames, and what calibrates all frames."""
    old, new, before, novelty = model.rules, its.rules, model.novelty, its.novelty
    assert before is not None
    assert novelty is not None
    labels, groups = old.overall.groups_, _end_to_end(old.overall.groups_, new.overall.groups_)
    known_p, at = old.known_p, None
    if labels is not None:  # the frames that calibrate are those of the references, in another order of units
        at = np.empty(len(labels), dtype=np.int64)
        at[np.argsort(labels, kind="stable")] = np.argsort(before.test.groups, kind="stable")
        if before.matched is None:
            known_p = np.where(known_p > 0, novelty.test.left_out_p_values()[at], 0.0)
    known_p = np.concatenate((known_p, new.known_p))
    if before.matched is not None and novelty.matched is not None:
        scores = before.matched.scores_  # below 0 where a place was recognised, else distances
        scores = scores if at is None else np.where(scores < 0, scores, novelty.test.scores_[at])
        scores = np.concatenate((scores, novelty.matched.scores_))
        test = novelty.test.rescored(scores, np.arange(len(scores)) if groups is None else groups)
        novelty = replace(novelty, matched=test)
        known_p = np.where(known_p > 0, test.left_out_p_values(), 0.0)
        new = replace(new, known_p=known_p[len(old.known_p) :])
    assert (old.recognised is None) == (new.recognised is None)  # the sources are the same
    recognised = None
    if old.recognised is not None and new.recognised is not None:
        recognised = np.concatenate((old.recognised, new.recognised))
    rules = replace(old, overall=_both(old.overall, new.overall), recognised=recognised, known_p=known_p)
    return replace(its, rules=new, novelty=novelty), replace(its, rules=rules, novelty=novelty)


def _both(old: SplitConformal, new: SplitConformal) -> SplitConformal:
    """The rule of the new frames, calibrated on the scores of all; added frames are a batch of their own."""
    before = np.zeros(len(old.scores_), dtype=np.int64) if old.batches_ is None else old.batches_
    return copy(new).calibrate_scores(
        np.concatenate((old.scores_, new.scores_)),
        _end_to_end(old.groups_, new.groups_),
        _end_to_end(old.group_sizes_, new.group_sizes_),
        np.concatenate((before, np.full(len(new.scores_), before.max(initial=-1) + 1))),
    )


def _end_to_end(old: IntArray | None, new: IntArray | None) -> IntArray | None:
    return None if old is None or new is None else np.concatenate((old, new))
