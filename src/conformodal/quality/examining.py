"""Is a recording good enough? Findings from its poses, a model's regions and the model's calibration."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from conformodal.core.arrays import IntArray, evenly_spread
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory
from conformodal.io import ImageError, Recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.radius import depth_or_default
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.identity import identify
from conformodal.pipeline.model import Localization, PoseModel
from conformodal.tracking.motions import frame_features

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
    trained: IntArray  # (k,) numbers of the frames that the model's sources were trained on; all without a model
    scale: ViewScale
    coverage: PoseCoverage | None  # from poses alone; None without
    ambiguity: Ambiguity | None = None  # of held-out frames; None without a model, or where it knows all frames
    guarantees: list[EvidenceGuarantee] = field(default_factory=list)  # of the model, by evidence type

    @property
    def n_held_out(self) -> int:
        """Frames with a pose that the model's sources were not trained on."""
        return int(np.setdiff1d(self.posed, self.trained).size)

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
        trained, views, depth_m = posed, poses, _depth(sequence)
    else:
        model.check_camera(sequence.camera)
        trained = frames = model.localizer.frames
        if not just_trained:
            trained = model.known_frames.find(identify(sequence))[frames]
        rows, depth_m = model.known_frames.poses[frames], model.prior.depth_m
        views = Trajectory(np.arange(float(len(rows))), rows[:, :3], rows[:, 3:])
    scale = ViewScale.of(sequence.camera, depth_or_default(depth_m))
    coverage = None
    if poses is not None and views is not None:
        coverage = pose_coverage(poses, recording[posed], views, scale, posed)
    if model is None:
        return RecordingQuality(sequence, posed, poses, trained, scale, coverage)
    held_out = np.setdiff1d(np.arange(len(sequence)), trained)
    most = QUALITY.most_after_training if just_trained else QUALITY.most_looked
    frames, answers = _localize(sequence, model, held_out[evenly_spread(len(held_out), most)], cache, progress)
    places = None if answers is None else ambiguity(frames, recording[frames], answers, scale)
    return RecordingQuality(sequence, posed, poses, trained, scale, coverage, places, guarantees(model))


def _localize(
    sequence: Recording, model: PoseModel, frames: IntArray, cache: FeatureCache | None, progress: StageProgress | None
) -> tuple[IntArray, Localization | None]:
    """Those of some frames whose images can be read, and the model's answers to each alone."""
    report, usable, local = stage_of(progress, "held-out"), [], []
    for done, i in enumerate(frames.tolist(), start=1):
        with suppress(ImageError):
            sequence.image(i)
            usable.append(i)
            if model.looks_at_local_features:
                local.append(frame_features(sequence, i))
        if report is not None:
            report(done, len(frames))
    files, cache = [sequence.image_paths[i] for i in usable], cache or FeatureCache(None)
    features = extract_features(files, model.backbone, cache, stage_of(progress, "network"), sequence.noise)
    answers = model.localize(FrameEvidence(features, local)) if usable else None
    return np.array(usable, dtype=np.int64), answers


def _depth(sequence: Recording) -> float:
    """Of what the camera sees, from images and poses; NaN where it cannot be told."""
    if sequence.truth is None:
        return float("nan")
    try:
        return measure_depths(sequence, np.arange(len(sequence)))[0]
    except ImageError:
        return float("nan")
