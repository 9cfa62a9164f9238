"""Is a recording good enough? Findings from its poses, a model's regions and the model's calibration."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

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
    ambiguity: Ambiguity | None = None  # of held-out frames; None without a model, or where it knows all frames
    guarantees: list[EvidenceGuarantee] = field(default_factory=list)  # of the model, by evidence type

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


def examine(
    sequence: Recording,
    model: PoseModel | None = None,
    *,
    just_trained: bool = False,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
) -> RecordingQuality:
    """Assess a recording, with poses or without, by a model or by its poses alone.

    Parameters
    ----------
    model
        The frames that it was trained on are recognised by their files; the others are held out. None takes all
        frames as known.
    just_trained
        Whether the model was trained on this very recording: fewer held-out frames are looked at then.
    """
    posed, poses, recording = sequence.posed, sequence.poses, sequence.recording
    if model is None:
        scale = ViewScale.of(sequence.camera, depth_or_default(_depth(sequence)))
        coverage = None if poses is None else pose_coverage(poses, recording[posed], poses, scale, posed)
        return RecordingQuality(sequence, posed, poses, posed, scale, coverage)
    model.check_camera(sequence.camera)
    frames = model.localizer.frames
    at = frames if just_trained else model.known_frames.find(identify(sequence))[frames]
    rows = model.known_frames.poses[frames]
    known = Trajectory(np.arange(len(rows), dtype=np.float64), rows[:, :3], rows[:, 3:])
    scale = ViewScale.of(sequence.camera, depth_or_default(model.prior.depth_m))
    coverage = None if poses is None else pose_coverage(poses, recording[posed], known, scale, posed)
    unseen = np.setdiff1d(np.arange(len(sequence)), at)
    most = QUALITY.most_after_training if just_trained else QUALITY.most_looked
    unseen = unseen[evenly_spread(len(unseen), most)]
    held_out, evidence = _look(sequence, model, unseen, cache or FeatureCache(None), progress)
    places = ambiguity(held_out, recording[held_out], model.localize(evidence), scale) if len(held_out) else None
    return RecordingQuality(sequence, posed, poses, at, scale, coverage, places, guarantees(model))


def _look(
    sequence: Recording, model: PoseModel, frames: IntArray, cache: FeatureCache, progress: StageProgress | None
) -> tuple[IntArray, FrameEvidence]:
    """Those of some frames whose images can be read, and what is looked at in each."""
    report, usable, local = stage_of(progress, "held-out"), [], []
    for done, i in enumerate(frames.tolist(), start=1):
        with suppress(ImageError):
            sequence.image(i)
            usable.append(i)
            if model.looks_at_local_features:
                local.append(frame_features(sequence, i))
        if report is not None:
            report(done, len(frames))
    files = [sequence.image_paths[i] for i in usable]
    features = extract_features(files, model.backbone, cache, stage_of(progress, "network"), sequence.noise)
    return np.array(usable, dtype=np.int64), FrameEvidence(features, local)


def _depth(sequence: Recording) -> float:
    """Of what the camera sees, from images and poses; NaN where it cannot be told."""
    if sequence.truth is None:
        return float("nan")
    try:
        return measure_depths(sequence, np.arange(len(sequence)))[0]
    except ImageError:
        return float("nan")
