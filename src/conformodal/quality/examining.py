"""Is a recording good enough? Findings from its poses, a model's regions and the model's calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, IntArray, evenly_spread
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory
from conformodal.io import ImageError, Recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.radius import depth_or_default
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.identity import identify
from conformodal.pipeline.model import PoseModel
from conformodal.tracking.flow import frame_features

from .guarantee import EvidenceGuarantee, guarantees
from .place_ambiguity import Ambiguity, ambiguity
from .settings import QUALITY
from .view_coverage import PoseCoverage, ViewScale, pose_coverage


@dataclass(frozen=True, eq=False)
class RecordingQuality:
    """Findings about a recording."""

    sequence: Recording
    posed: IntArray  # (n,) numbers of the frames that have a pose
    poses: Trajectory | None  # theirs; None where none has one
    # (k,) numbers of the frames that the model's sources know, -1 where the recording lacks them; all without a model
    known_names: IntArray
    scale: ViewScale
    coverage: PoseCoverage | None  # from poses alone; None without
    ambiguity: Ambiguity | None  # of held-out frames; None without a model, or where it knows all frames
    guarantees: list[EvidenceGuarantee]  # of the model, by evidence type; empty without one

    @property
    def known(self) -> BoolArray:
        """(n,) whether the model's sources know each frame with a pose."""
        return np.isin(self.posed, self.known_names)

    @property
    def axes(self) -> tuple[int, int]:
        """The two axes along which the positions spread most."""
        extent = np.zeros(3) if self.poses is None else np.ptp(self.poses.positions_xyz, axis=0)
        first, second = sorted(np.argsort(-extent, kind="stable")[:2].tolist())
        return first, second


# Gives, of held-out frames, those that can be used and what is looked at in each.
Look = Callable[[IntArray], tuple[IntArray, FrameEvidence]]


def examine(
    sequence: Recording,
    model: PoseModel | None = None,
    *,
    just_trained: Look | None = None,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
) -> RecordingQuality:
    """Assess a recording, with poses or without, by a model or by its poses alone.

    Parameters
    ----------
    model
        The frames that it was trained on are known by their pixels; the others are held out. None takes all frames as
        known.
    just_trained
        Given if the model was trained on this very sequence: held-out frames are looked at by it.
    """
    posed, poses, recording = sequence.posed, sequence.poses, sequence.recording
    if model is None:
        scale = ViewScale.of(sequence.camera, depth_or_default(_depth(sequence)))
        coverage = None if poses is None else pose_coverage(poses, recording[posed], poses, scale, posed)
        return RecordingQuality(sequence, posed, poses, posed, scale, coverage, None, [])
    model.check_camera(sequence.camera)
    frames = model.localizer.frames
    at = frames if just_trained else model.known_frames.find(identify(sequence, model.known_frames)).at[frames]
    its = model.known_frames.poses[frames]
    known = Trajectory(np.arange(len(its), dtype=np.float64), its[:, :3], its[:, 3:])
    scale = ViewScale.of(sequence.camera, depth_or_default(model.prior.depth_m))
    coverage = None if poses is None else pose_coverage(poses, recording[posed], known, scale, posed)
    unseen, places = np.setdiff1d(np.arange(len(sequence)), at), None
    most = QUALITY.most_after_training if just_trained else QUALITY.most_looked
    unseen = unseen[evenly_spread(len(unseen), most)]
    held, evidence = (just_trained or _looker(sequence, model, cache or FeatureCache(None), progress))(unseen)
    if len(held):
        truth = poses[np.searchsorted(posed, held)] if poses is not None and np.isin(held, posed).all() else None
        found = model.localize(evidence)
        places = ambiguity(held, recording[held], found, known, truth, model.sign_reference, scale)
    return RecordingQuality(sequence, posed, poses, at, scale, coverage, places, guarantees(model))


def _looker(sequence: Recording, model: PoseModel, cache: FeatureCache, progress: StageProgress | None) -> Look:
    """Computes features of images; images that cannot be read are left out."""

    def look(wanted: IntArray) -> tuple[IntArray, FrameEvidence]:
        report, usable, local = stage_of(progress, "held-out"), [], []
        for done, i in enumerate(wanted.tolist(), start=1):
            try:
                sequence.image(i)
            except ImageError:
                continue
            usable.append(i)
            if model.looks_at_local_features:
                local.append(frame_features(sequence, i))
            if report is not None:
                report(done, len(wanted))
        files = [sequence.image_paths[i] for i in usable]
        features = extract_features(files, model.backbone, cache, stage_of(progress, "network"), sequence.noise)
        return np.array(usable, dtype=np.int64), FrameEvidence(features, local)

    return look


def _depth(sequence: Recording) -> float:
    """Of what the camera sees, from images and poses; NaN where it cannot be told."""
    if sequence.truth is None:
        return float("nan")
    try:
        return measure_depths(sequence, np.arange(len(sequence)))[0]
    except ImageError:
        return float("nan")
