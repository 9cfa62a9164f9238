"""``conformodal train``: train, calibrate, save."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.arrays import IntArray
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.features.networks.registry import NETWORKS, find_network
from conformodal.features.settings import TrainingConfig
from conformodal.io import Layout, Recording, SplitKind
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.pipeline.config import Calibration, Method, ModelConfig, Runtime
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results.folders import lock_output
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.results.runs import write_metrics
from conformodal.pipeline.store import model_digest, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.pipeline.training_data import TrainingData
from conformodal.quality.advice import describe_guarantee, describe_quality, quality_record, record_next
from conformodal.quality.examining import RecordingQuality, examine
from conformodal.quality.guarantee import guarantees

from .console import console, print_where, progress_bars, report_errors, report_line, report_strongly
from .model_notes import describe_calibration, describe_distances, describe_landmarks, describe_repeated, distances
from .options import OptionError, share_of, was_given
from .sources import AllData, Cache, DataLayout, Focal, FollowOutside, cache_folder, open_sequences

_MOST_ADVICE = 3
# Settings whose options have other names.
_OPTIONS = {"sigma_bins": "sigma", "calibrate_on": "calibration"}


@report_errors
def train(
    context: typer.Context,
    data: AllData,
    out: Annotated[Path, typer.Option(help="Folder to save the model in.")],
    layout: DataLayout = Layout.AUTO,
    method: Annotated[
        Method,
        typer.Option(
            help="conformodal, or paper: the paper's system; options that are left alone then have the paper's values."
        ),
    ] = ModelConfig.method,
    split: Annotated[
        SplitKind,
        typer.Option(
            help="How frames are held out: at random, in stretches, in whole recordings, or by the data set's lists."
        ),
    ] = ModelConfig.split,
    alpha: Annotated[float, typer.Option(help="Miscoverage rate: the region may miss this share of poses.")] = (
        ModelConfig.alpha
    ),
    joint: Annotated[
        str,
        typer.Option(
            help="What alpha is for. max: the whole pose, with one threshold; bonferroni: the whole pose, alpha / 7 "
            "for each target; none: each target alone, as in the paper."
        ),
    ] = (ModelConfig.joint),
    score: Annotated[
        str,
        typer.Option(help="Nonconformity score: hpd, hpd_random, aps, density, linear_density, lac (the paper's)."),
    ] = ModelConfig.score,
    bins: Annotated[int, typer.Option(help="Bins per target (K).")] = ModelConfig.n_bins,
    sigma: Annotated[float, typer.Option(help="Width of the labels in bins; 0: one-hot, as in the paper.")] = (
        ModelConfig.sigma_bins
    ),
    epochs: Annotated[int, typer.Option(help="Passes over the training part.")] = TrainingConfig.epochs,
    dropout: Annotated[float, typer.Option(help="Share of features dropped in training.")] = (TrainingConfig.dropout),
    test: Annotated[
        str,
        typer.Option(
            metavar="SHARE|DATA",
            help="Share of all frames (or recordings) held out for testing; or another data set that is held out "
            "whole, which implies --split given.",
        ),
    ] = str(ModelConfig.test),
    calibration: Annotated[
        Calibration,
        typer.Option(
            help="What the regions are calibrated on. frames: the calibration part. stretches: stretches (or "
            "recordings) of training and calibration part, each answered by sources that did not see it. auto: frames "
            "for --split interleaved, else stretches."
        ),
    ] = ModelConfig.calibrate_on,
    calibration_share: Annotated[
        float, typer.Option(help="Share of all frames (or recordings) held out to calibrate.")
    ] = ModelConfig.calibration,
    novelty_level: Annotated[
        float | None,
        typer.Option(
            help="An image whose p-value of showing a known place is at most this gets an unbounded region; "
            "0.015 by default where frames calibrate, 0.1 where stretches do."
        ),
    ] = ModelConfig.novelty_level,
    used: Annotated[
        float | None, typer.Option(help="Share of all frames for training and calibration together; all the rest.")
    ] = None,
    network: Annotated[str, typer.Option(help=f"Network of the features: {', '.join(NETWORKS)}.")] = (
        ModelConfig.network
    ),
    sources: Annotated[
        str,
        typer.Option(help="Pose sources that the belief is made of, in order, separated by commas."),
    ] = ",".join(ModelConfig.sources),
    device: Annotated[str, typer.Option(help="Of the network: cpu, cuda, or auto.")] = ModelConfig.device,
    runtime: Annotated[
        Runtime, typer.Option(help="What runs the network: onnx, int8 (smaller, less exact), or torch.")
    ] = ModelConfig.runtime,
    seed: Annotated[int, typer.Option(help="Of the split and of training.")] = 0,
    focal: Focal = None,
    follow_outside: FollowOutside = False,
    cache: Cache = None,
) -> None:
    """Train on a data set with poses, calibrate, and save the model."""
    held_out = Path(test) if share_of(test) is None else None
    if held_out is not None:
        if was_given(context, "split") and split is not SplitKind.GIVEN:
            raise OptionError(f"--test {held_out} is a data set, which needs --split given, got --split {split}")
        split = SplitKind.GIVEN
    settings: dict[str, Any] = {
        "split": split,
        "n_bins": bins,
        "sigma_bins": sigma,
        "alpha": alpha,
        "score": score,
        "joint": joint,
        "test": ModelConfig.test if share_of(test) is None else share_of(test),
        "calibration": calibration_share,
        "calibrate_on": calibration,
        "novelty_level": novelty_level,
        "used": used,
        "network": network,
        "sources": tuple(name.strip() for name in sources.split(",")),
        "device": device,
        "runtime": runtime,
        "seed": seed,
        "training": replace(TrainingConfig(), epochs=epochs, dropout=dropout, seed=seed),
    }
    if method is Method.PAPER:  # options that were left alone are the paper's then
        given, default = {name for name in settings if was_given(context, _OPTIONS.get(name, name))}, ModelConfig()
        given |= {name for name, value in settings.items() if value != getattr(default, name)}
        given -= {"calibrate_on"} if calibration is Calibration.AUTO else set()
        config = ModelConfig.paper(**{name: settings[name] for name in given})
    else:
        config = ModelConfig(**settings)
    _ = find_network(network).block  # refuses a model of transformers that is not here, before images are read
    with lock_output(out, "train", apart=[*data, *([] if held_out is None else [held_out])]):
        cache_dir = cache_folder(cache)
        sequence = open_sequences(
            data, layout, require_poses=True, follow_outside=follow_outside, focal=focal, test=held_out
        )
        with progress_bars(out) as report:
            train_on(sequence, config, out, cache_dir=cache_dir, report=report)
    print_where(out)


def train_on(
    sequence: Recording,
    config: ModelConfig,
    out: Path,
    *,
    cache_dir: Path,
    report: StageProgress,
) -> PoseModel:
    """Train, calibrate and save; says what a user should know of the model."""
    started = time.perf_counter()
    data = prepare_training_data(sequence, config, FeatureCache(cache_dir), report)
    model = train_model(data, config, progress=report)
    # at the end: until then, a model that was there before is whole
    save_model(model, out)
    quality = _quality_of(data, model, config)
    split = model.split
    parts = {"train": len(split.train), "calibration": len(split.calibration), "test": len(split.test)}
    used, frames = np.concatenate((split.train, split.calibration)), model.known_frames
    repeated = int(frames.take(used).known(frames.take(split.test)).sum())
    metrics = {
        "command": "train",
        "model": model_digest(out),
        "provenance": provenance(),
        "configuration": model.settings,
        "seed": config.seed,
        "split": {
            "kind": str(split.kind),
            **parts,
            **distances(split, sequence.recording),
            "n_test_same_picture": repeated,
        },
        "source_comparison": None if model.comparison is None else asdict(model.comparison),
        "landmarks": None if model.landmarks is None else model.landmarks.summary,
        "quality": None if quality is None else quality_record(quality),
        "seconds": round(time.perf_counter() - started, 2),
    }
    write_metrics(out, metrics)
    console.print(
        f"{sequence.name}: {counted(parts['train'], 'frame')} for training, {parts['calibration']} for calibration, "
        f"{parts['test']} held out for testing (split {split.kind}, seed {split.seed})"
    )
    report_line(describe_distances(split, sequence.recording))
    for line in describe_repeated(repeated, len(split.test)):
        report_strongly(line)
    if LandmarkSource.name in config.sources:
        console.print(describe_landmarks(model.landmarks, model.camera))
    for line in describe_calibration(model, config, len(np.unique(sequence.recording[used]))):
        report_line(line)
    if model.comparison is not None:
        report_line(model.comparison.describe())
        if model.comparison.too_sure:
            report_strongly(
                "The model's sources are too sure of new stretches, and the coverage guarantee does not reach them: "
                "calibrate on recordings (more of them), or on frames held out from the model (--calibration frames)."
            )
    if quality is None:
        lines = [describe_guarantee(guarantee) for guarantee in guarantees(model)]
    else:
        lines = [*describe_quality(quality), *record_next(quality)[:_MOST_ADVICE]]
    for line in lines:
        report_line(line)
    return model


def _quality_of(data: TrainingData, model: PoseModel, config: ModelConfig) -> RecordingQuality | None:
    """Of the recording that a model was just trained on; None for the paper's system, which has no more to say."""
    if config.method is Method.PAPER:
        return None
    local_features = data.for_sources(config).local_features

    def look(frames: IntArray) -> tuple[IntArray, FrameEvidence]:
        local = local_features(frames) if model.looks_at_local_features else ()
        return frames, FrameEvidence(data.features[frames], local)

    return examine(data.sequence, model, just_trained=look)
