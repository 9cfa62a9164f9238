"""``conformodal train``: train, calibrate, save."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, noun_for
from conformodal.features.extract import FeatureCache
from conformodal.features.networks.registry import NETWORKS, find_network
from conformodal.features.settings import TrainingConfig
from conformodal.io import Layout, Recording, SplitKind
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.pipeline.config import Calibration, Method, ModelConfig, Runtime
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.pipeline.store import model_digest, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.quality.advice import advice, numbers, quality_record, verdict
from conformodal.quality.examining import examine
from conformodal.quality.guarantee import guarantees

from .console import print_where, progress_bars, report_line, report_strongly
from .failures import OptionError, report_errors
from .model_notes import describe_calibration, describe_distances, describe_landmarks, distances
from .sources import (
    DATA_PANEL,
    AllData,
    Cache,
    DataLayout,
    Focal,
    FollowOutside,
    cache_folder,
    open_sequences,
    was_given,
)

_data, _model, _calibration = (
    partial(typer.Option, rich_help_panel=panel) for panel in (DATA_PANEL, "Model", "Calibration")
)
# Settings whose options have other names.
_OPTIONS = {"n_bins": "bins", "sigma_bins": "sigma", "calibrate_on": "calibration", "calibration": "calibration_share"}


@report_errors()
def train(
    context: typer.Context,
    data: AllData,
    out: Annotated[Path, typer.Option(help="Folder to save the model in.")],
    method: Annotated[
        Method,
        typer.Option(help="conformodal, or paper: the paper's system, with its values of options that are left alone."),
    ] = ModelConfig.method,
    seed: Annotated[int, typer.Option(min=0, help="Of the split and of training.")] = 0,
    cache: Cache = None,
    layout: DataLayout = Layout.AUTO,
    split: Annotated[
        SplitKind,
        _data(help="How frames are held out: at random, in stretches, in recordings, or by the data set's lists."),
    ] = ModelConfig.split,
    test: Annotated[
        str,
        _data(
            metavar="SHARE|DATA",
            help="Share of all frames (or recordings) held out for testing; or another data set that is held out "
            "whole, which implies --split given.",
        ),
    ] = str(ModelConfig.test),
    calibration_share: Annotated[float, _data(help="Share of all frames (or recordings) held out to calibrate.")] = (
        ModelConfig.calibration
    ),
    used: Annotated[float | None, _data(help="Share of all frames for training and calibration together.")] = None,
    focal: Focal = None,
    follow_outside: FollowOutside = False,
    sources: Annotated[str, _model(help="Pose sources of the belief, in order, separated by commas.")] = (
        ",".join(ModelConfig.sources)
    ),
    network: Annotated[str, _model(help=f"Network of the features: {', '.join(NETWORKS)}.")] = ModelConfig.network,
    runtime: Annotated[Runtime, _model(help="Of the network: onnx, int8 (smaller, less exact), or torch.")] = (
        ModelConfig.runtime
    ),
    device: Annotated[str, _model(help="Of the network: cpu, cuda, or auto.")] = ModelConfig.device,
    bins: Annotated[int, _model(min=1, help="Bins per target (K).")] = ModelConfig.n_bins,
    sigma: Annotated[float, _model(min=0, help="Width of the labels in bins; 0: one-hot, as in the paper.")] = (
        ModelConfig.sigma_bins
    ),
    epochs: Annotated[int, _model(min=1, help="Passes over the training part.")] = TrainingConfig.epochs,
    dropout: Annotated[float, _model(min=0, max=0.95, help="Share of features dropped in training.")] = (
        TrainingConfig.dropout
    ),
    alpha: Annotated[float, _calibration(help="Miscoverage rate: the region may miss this share of poses.")] = (
        ModelConfig.alpha
    ),
    joint: Annotated[
        str,
        _calibration(
            help="What alpha is for. max: the whole pose, with one threshold; bonferroni: the whole pose, alpha / 7 "
            "for each target; none: each target alone, as in the paper."
        ),
    ] = ModelConfig.joint,
    score: Annotated[
        str, _calibration(help="Nonconformity score: hpd, hpd_random, aps, density, lac (the paper's).")
    ] = ModelConfig.score,
    calibration: Annotated[
        Calibration,
        _calibration(
            help="What the regions are calibrated on. frames: the calibration part. stretches: stretches (or "
            "recordings) of training and calibration part, each answered by sources that did not see it. auto: frames "
            "for --split interleaved, else stretches."
        ),
    ] = ModelConfig.calibrate_on,
    novelty_level: Annotated[
        float | None,
        _calibration(
            min=0,
            max=1,
            help="An image whose p-value of showing a known place is at most this gets an unbounded region; "
            "0.015 by default where frames calibrate, 0.1 where stretches do.",
        ),
    ] = ModelConfig.novelty_level,
) -> None:
    """Train on a data set with poses, calibrate, and save the model."""
    share, held_out = ModelConfig.test, None
    try:
        share = float(test)
    except ValueError:
        held_out = Path(test)
        if was_given(context, "split") and split is not SplitKind.GIVEN:
            raise OptionError(f"--test {test} is a data set, which needs --split given, got --split {split}") from None
        split = SplitKind.GIVEN
    settings: dict[str, Any] = {
        "split": split,
        "n_bins": bins,
        "sigma_bins": sigma,
        "alpha": alpha,
        "score": score,
        "joint": joint,
        "test": share,
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
        features = FeatureCache(cache_folder(cache))
        sequence = open_sequences(
            data, layout, require_poses=True, follow_outside=follow_outside, focal=focal, test=held_out
        )
        with progress_bars(out) as report:
            train_on(sequence, config, out, features=features, report=report)
    print_where(out)


def train_on(
    sequence: Recording, config: ModelConfig, out: Path, *, features: FeatureCache, report: StageProgress
) -> PoseModel:
    """Train, calibrate and save; prints what a user should know of the model."""
    started = time.perf_counter()
    model = train_model(prepare_training_data(sequence, config, features, report), config, progress=report)
    save_model(model, out)  # at the end: until then, a model that was there before is whole
    split, frames = model.split, model.known_frames
    used = np.concatenate((split.train, split.calibration))
    parts = {name: len(split.part(name)) for name in ("train", "calibration", "test")}
    repeated = int(frames.take(used).known(frames.take(split.test)).sum())
    distance = distances(split, sequence.recording)
    quality = None
    if config.method is not Method.PAPER:  # whose system has no more to say
        quality = examine(sequence, model, just_trained=True, cache=features)
    metrics = {
        "command": "train",
        "model": model_digest(out),
        "provenance": provenance(),
        "configuration": model.settings,
        "seed": config.seed,
        "split": {"kind": str(split.kind), **parts, **distance, "n_test_same_picture": repeated},
        "source_comparison": None if model.comparison is None else asdict(model.comparison),
        "landmarks": None if model.landmarks is None else model.landmarks.summary,
        "quality": None if quality is None else quality_record(quality),
        "seconds": round(time.perf_counter() - started, 2),
    }
    write_metrics(out, metrics)
    report_line(
        f"{sequence.name}: {counted(parts['train'], 'frame')} for training, {parts['calibration']} for calibration, "
        f"{parts['test']} held out for testing (split {split.kind}, seed {split.seed})"
    )
    report_line(describe_distances(distance))
    if repeated:
        report_strongly(
            f"{repeated} of {counted(parts['test'], 'test frame')} {noun_for(repeated, 'shows', 'show')} the same "
            "picture as a training or calibration frame: their errors do not tell what to expect of new images"
        )
    if LandmarkSource.name in config.sources:
        report_line(describe_landmarks(model.landmarks, model.camera))
    for line in describe_calibration(model, config, len(np.unique(sequence.recording[used]))):
        report_line(line)
    if model.comparison is not None:
        report_line(model.comparison.describe())
        if model.comparison.too_sure:
            report_strongly(
                "The model's sources are too sure of new stretches, and the coverage guarantee does not reach them: "
                "calibrate on recordings (more of them), or on frames held out from the model (--calibration frames)."
            )
    lines = [one.describe() for one in guarantees(model)] if quality is None else numbers(quality)
    for line in lines:
        report_line(line)
    if quality is not None:
        report_strongly(verdict(quality))
        for line in advice(quality):
            report_line(line)
    return model
