"""Is a recording good enough? What poses, a model's regions and its calibration say together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.progress import StageProgress, stage_of
from conformodal.datasets import ImageError, Sequence
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.local_features import LocalFeatures, extract_local_features
from conformodal.model.identity import identify
from conformodal.model.model import PoseModel
from conformodal.model.radius import depth_or_default
from conformodal.poses import Trajectory
from conformodal.training.depths import measure_depths
from conformodal.training.training_data import TrainingData
from conformodal.vision.features import FeatureCache, extract_features

from .guarantee import EvidenceGuarantee, guarantees
from .place_ambiguity import Ambiguity, ambiguity, most_probable
from .settings import QUALITY
from .view_coverage import PoseCoverage, pose_coverage
from .views import ViewScale


@dataclass(frozen=True, eq=False)
class RecordingQuality:
    """What can be said of a recording.

    Attributes
    ----------
    posed
        (n,) numbers of the frames that have a pose.
    poses
        Theirs; None where none has one.
    known
        (n,) whether the model's sources know each of them; all of them without a model.
    known_names
        (k,) numbers of the known frames, for people: in the recording, or -1 where it lacks them.
    scale
        What is near; None without poses.
    coverage
        From poses alone; None without.
    ambiguity
        Of held-out frames; None without a model, or where it knows all frames.
    promises
        Of the model, by kind of evidence; empty without one.
    errors_m
        (m,) position errors of the belief about each of the m held-out frames by itself; None where they have no poses.
    """

    posed: IntArray
    poses: Trajectory | None
    known: npt.NDArray[np.bool_]
    known_names: IntArray
    scale: ViewScale | None
    coverage: PoseCoverage | None
    ambiguity: Ambiguity | None
    guarantees: list[EvidenceGuarantee]
    errors_m: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Frames of a recording that no source of a model has seen, and what is looked at in them.

    Attributes
    ----------
    frames
        (m,) their numbers.
    evidence
        Of each.
    """

    frames: IntArray
    evidence: FrameEvidence


def examine(
    sequence: Sequence,
    model: PoseModel | None = None,
    *,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
) -> RecordingQuality:
    """Judge a recording, with a model or by its poses alone.

    Parameters
    ----------
    sequence
        Frames, with poses or without.
    model
        Which frames it knows is told by their pixels; the others are held out. None takes all frames for known.
    cache
        Of features.
    progress
        Called with stage, frames done and frames in all.

    Raises
    ------
    OdometryError
        If the camera is not the model's.
    """
    posed, poses = _frames_with_pose(sequence)
    if model is None:
        return _judged(sequence, posed, poses, np.arange(len(posed)), _depth(sequence))
    model.check_camera(sequence.camera)
    at = model.known_frames.find(identify(sequence, model.known_frames)).at[model.localizer.frames]
    unseen = np.setdiff1d(np.arange(len(sequence)), at)
    held = _look_at(sequence, model, unseen, cache or FeatureCache(None), progress)
    return _judged(sequence, posed, poses, at, model.prior.depth_m, model, held)


def examine_training(
    data: TrainingData, model: PoseModel, local_features: Callable[[IntArray], list[LocalFeatures]]
) -> RecordingQuality:
    """Judge the recording that a model was just trained on, from what is there already.

    Parameters
    ----------
    data
        What it was trained on.
    model
        Trained.
    local_features
        Gives those of frames.
    """
    unseen = np.setdiff1d(np.arange(len(data.sequence)), model.localizer.frames)
    frames = _spread(unseen, QUALITY.most_after_training)
    local = local_features(frames) if model.looks_at_local_features else ()
    posed, poses = _frames_with_pose(data.sequence)
    held = HeldOut(frames, FrameEvidence(data.features[frames], local))
    return _judged(data.sequence, posed, poses, model.localizer.frames, model.prior.depth_m, model, held)


def _frames_with_pose(sequence: Sequence) -> tuple[IntArray, Trajectory | None]:
    """Numbers of the frames that have a pose, and the poses."""
    if sequence.truth is not None:
        return np.arange(len(sequence)), sequence.truth
    if sequence.known_poses is None or not len(sequence.known_poses):
        return np.empty(0, dtype=np.int64), None
    return np.searchsorted(sequence.timestamps_s, sequence.known_poses.timestamps_s), sequence.known_poses


def _spread(frames: IntArray, most: int) -> IntArray:
    """At most `most` of the frames, evenly spread."""
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), most))
    return frames[chosen.round().astype(np.int64)]


def _look_at(
    sequence: Sequence, model: PoseModel, held_out: IntArray, cache: FeatureCache, progress: StageProgress | None
) -> HeldOut:
    """Features of some of the frames that are held out; those that cannot be read are left out."""
    report, usable, local = stage_of(progress, "held-out"), [], []
    wanted = _spread(held_out, QUALITY.most_looked)
    for done, i in enumerate(wanted.tolist(), start=1):
        try:
            image = sequence.image(i)
        except ImageError:
            continue
        usable.append(i)
        local.append(extract_local_features(image, sequence.camera) if model.looks_at_local_features else None)
        if report is not None:
            report(done, len(wanted))
    files = [sequence.image_paths[i] for i in usable]
    features = extract_features(files, model.backbone, cache, stage_of(progress, "network"), sequence.noise)
    return HeldOut(np.array(usable, dtype=np.int64), FrameEvidence(features, local))


def _judged(
    sequence: Sequence,
    posed: IntArray,
    poses: Trajectory | None,
    known_names: IntArray,
    depth_m: float,
    model: PoseModel | None = None,
    held: HeldOut | None = None,
) -> RecordingQuality:
    scale = ViewScale.of(sequence.camera, depth_or_default(depth_m))
    if model is None:
        known = poses
    else:
        its = model.known_frames.poses[model.localizer.frames]
        known = Trajectory(np.arange(len(its), dtype=np.float64), its[:, :3], its[:, 3:])
    coverage = None
    if poses is not None and known is not None:
        coverage = pose_coverage(poses, sequence.recording[posed], known, scale)
    places, errors = None, None
    if model is not None and known is not None and held is not None and len(held.frames):
        found = model.localize(held.evidence)
        truth = None
        if poses is not None and np.isin(held.frames, posed).all():
            truth = poses[np.searchsorted(posed, held.frames)]
            errors = np.linalg.norm(most_probable(found) - truth.positions_xyz, axis=1)
        own = sequence.recording[held.frames]
        places = ambiguity(held.frames, own, found, known, truth, model.sign_reference, scale)
    return RecordingQuality(
        posed,
        poses,
        np.isin(posed, known_names),
        known_names,
        None if poses is None else scale,
        coverage,
        places,
        [] if model is None else guarantees(model),
        errors,
    )


def _depth(sequence: Sequence) -> float:
    """Of what the camera sees, from images and poses; NaN where it cannot be told."""
    if sequence.truth is None:
        return float("nan")
    try:
        return measure_depths(sequence, np.arange(len(sequence)))[0]
    except ImageError:
        return float("nan")
