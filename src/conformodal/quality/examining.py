"""Is a recording good enough? Findings from its poses, a model's regions and the model's calibration."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from conformodal.core.arrays import IntArray, evenly_spread
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.local import Detector, LocalFeatures
from conformodal.geometry import PoseError, Trajectory
from conformodal.io import ImageError, Recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.pipeline.guarantee import EvidenceGuarantee, guarantees
from conformodal.pipeline.identity import identify
from conformodal.pipeline.model import PoseModel
from conformodal.tracking.depths import scene_depth
from conformodal.tracking.motions import frame_features

from .view_coverage import QUALITY, Ambiguity, PoseCoverage, ViewScale, ambiguity, pose_coverage


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

    A model's training frames are recognised by their files; the others are held out. Without a model all frames count
    as known. `just_trained` says that the model was trained on this very recording: fewer frames are looked at then.
    """
    posed, poses, recording = sequence.posed, sequence.poses, sequence.recording
    if model is None:
        trained, views, depth_m = posed, poses, median_depth(sequence)
    else:
        model.check_camera(sequence.camera)
        model.check_unit(sequence)
        trained = frames = model.localizer.frames
        if not just_trained:
            trained = model.known_frames.find(identify(sequence))[frames]
        rows, depth_m = model.known_frames.poses[frames], model.prior.depth_m
        views = Trajectory(np.arange(float(len(rows))), rows[:, :3], rows[:, 3:])
    scale, coverage = ViewScale.of(sequence.camera, depth_m), None
    if poses is not None and views is not None:
        coverage = pose_coverage(poses, recording[posed], views, scale, posed)
    if model is None:
        return RecordingQuality(sequence, posed, poses, trained, scale, coverage)
    held_out = np.setdiff1d(np.arange(len(sequence)), trained)
    most = QUALITY.most_after_training if just_trained else QUALITY.most_looked
    local = _features_of(sequence, held_out[evenly_spread(len(held_out), most)], model.detector, progress)
    places, readable = None, np.array(list(local), dtype=np.int64)
    if local:
        files, stage = [sequence.image_paths[i] for i in local], stage_of(progress, "network")
        features = extract_features(files, model.backbone, cache or FeatureCache(None), stage, sequence.noise)
        answers = model.localize(FrameEvidence(features, list(local.values())))
        places = ambiguity(readable, recording[readable], answers, scale)
    return RecordingQuality(sequence, posed, poses, trained, scale, coverage, places, guarantees(model))


def median_depth(sequence: Recording) -> float:
    """Median depth in metres of what the camera sees, from images and poses; NaN where it cannot be told."""
    with suppress(ImageError, PoseError):
        return scene_depth(sequence, np.arange(len(sequence))).median_m
    return float("nan")


def _features_of(
    sequence: Recording, frames: IntArray, detector: Detector, progress: StageProgress | None
) -> dict[int, LocalFeatures]:
    """Local features of the frames whose images can be read."""
    report, local = stage_of(progress, "held-out"), dict[int, LocalFeatures]()
    for done, i in enumerate(frames.tolist(), start=1):
        with suppress(ImageError):
            local[i] = frame_features(sequence, i, detector)
        if report is not None:
            report(done, len(frames))
    return local
