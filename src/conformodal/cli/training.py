"""Training, saving and describing a model, as train and demo do."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, noun_for
from conformodal.features.extract import FeatureCache
from conformodal.io import Recording, frames_to_known
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import write_metrics
from conformodal.pipeline.store import model_digest, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.quality.advice import advice, numbers, quality_record, verdict
from conformodal.quality.examining import examine
from conformodal.quality.guarantee import guarantees

from .console import report_line, report_strongly

_NEAR_FRAMES = 5
_FOCAL_OFF = 0.02  # a focal length that differs by a larger share is reported


def train_on(
    sequence: Recording, config: ModelConfig, out: Path, *, features: FeatureCache, report: StageProgress
) -> PoseModel:
    """Train, calibrate and save; prints what a user should know of the model."""
    started = time.perf_counter()
    model = train_model(prepare_training_data(sequence, config, features, report), config, progress=report)
    save_model(model, out)  # at the end: until then, a model that was there before is whole
    split = _describe_split(model, sequence)
    quality = None
    if config.method is not Method.PAPER:  # whose system has no more to say
        quality = examine(sequence, model, just_trained=True, cache=features)
    metrics = {
        "command": "train",
        "model": model_digest(out),
        "provenance": provenance(),
        "configuration": model.settings,
        "seed": config.seed,
        "split": split,
        "source_comparison": None if model.comparison is None else asdict(model.comparison),
        "landmarks": None if model.landmarks is None else model.landmarks.summary,
        "quality": None if quality is None else quality_record(quality),
        "seconds": round(time.perf_counter() - started, 2),
    }
    write_metrics(out, metrics)
    _report_split(sequence.name, split, config.seed)
    for line in _describe_model(model):
        report_line(line)
    if model.comparison is not None and model.comparison.too_sure:
        report_strongly(
            "The model's sources are too sure of new stretches, and the coverage guarantee does not reach them: "
            "calibrate on recordings (more of them), or on frames held out from the model (--calibration frames)."
        )
    for line in [one.describe() for one in guarantees(model)] if quality is None else numbers(quality):
        report_line(line)
    if quality is not None:
        report_strongly(verdict(quality))
        for line in advice(quality):
            report_line(line)
    return model


def _describe_split(model: PoseModel, sequence: Recording) -> dict[str, Any]:
    """The parts of the data set for ``metrics.json``, and how near test frames are to training or calibration ones."""
    split, frames = model.split, model.known_frames
    used = frames.take(np.concatenate((split.train, split.calibration)))
    away = frames_to_known(split, sequence.recording)
    median = float(np.median(away))
    return {
        "kind": str(split.kind),
        **{name: len(split.part(name)) for name in ("train", "calibration", "test")},
        "median_frames_to_known": median if np.isfinite(median) else None,
        "share_within_5_frames": float(np.mean(away <= _NEAR_FRAMES)),
        "n_test_same_picture": int(used.known(frames.take(split.test)).sum()),
    }


def _report_split(name: str, split: dict[str, Any], seed: int) -> None:
    median, n_same = split["median_frames_to_known"], split["n_test_same_picture"]
    report_line(
        f"{name}: {counted(split['train'], 'frame')} for training, {split['calibration']} for calibration, "
        f"{split['test']} held out for testing (split {split['kind']}, seed {seed})"
    )
    if median is not None:
        report_line(
            f"test frames lie a median of {median:g} {noun_for(int(median), 'frame')} from the nearest training or "
            f"calibration frame, {100 * split['share_within_5_frames']:.0f} % of them within {_NEAR_FRAMES}"
        )
    if n_same:
        report_strongly(
            f"{n_same} of {counted(split['test'], 'test frame')} {noun_for(n_same, 'shows', 'show')} the same "
            "picture as a training or calibration frame: their errors do not tell what to expect of new images"
        )


def _describe_model(model: PoseModel) -> list[str]:
    """The landmarks, what calibrates the regions, the test for unknown places, and how sources compare."""
    lines, rule, landmarks = [], model.calibration, model.landmarks
    if landmarks is not None:
        n_landmarks, n_frames = (int(landmarks.summary[name]) for name in ("n_landmarks", "n_keyframes"))
        lines.append(f"{counted(n_landmarks, 'landmark')} of {counted(n_frames, 'frame')}")
        implied, given = landmarks.map.camera.fx, model.camera.fx
        if abs(implied / given - 1) > _FOCAL_OFF:
            lines[-1] += f"; the poses imply a focal length of {implied:.0f} px where {given:.0f} px is given: "
            lines[-1] += "check the camera"
    elif "landmarks" in model.settings["sources"]:
        lines.append("no landmarks: too few corners of the training frames could be triangulated; other sources answer")
    by = f"{counted(model.n_calibration, 'frame')} of the calibration part"
    if rule.units_ is not None:
        by = f"{rule.n_units} stretches or recordings, each answered by sources that did not see it"
    lines.append(f"regions are calibrated on {by} (joint {rule.joint})")
    if model.novelty is None:
        why = "the paper has no such test" if model.method is Method.PAPER else "the data are one piece"
        lines.append(f"images are not tested for unknown places: {why}")
    else:
        lines.append(
            f"an image is taken for an unknown place where its p-value is at most {model.rules.level:.3g}, or "
            f"{model.recognised_level:.3g} if a place is recognised"
        )
    return lines if model.comparison is None else [*lines, model.comparison.describe()]
