"""``conformodal train``: the options of training, and training itself, as ``demo`` does it too."""

from __future__ import annotations

import sys
import time
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.progress import StageProgress
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.features.local import XFeatDetector
from conformodal.features.networks import default_block
from conformodal.features.settings import NETWORKS, TrainingConfig
from conformodal.io import Layout, SplitKind
from conformodal.io.diagnosis.cameras import doubt_focal
from conformodal.localizer.sources.registry import find_source
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.config import Calibration, Method, ModelConfig
from conformodal.pipeline.guarantee import describe_guarantee, short_guarantee
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.pipeline.store import model_digest, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.pipeline.workers import Engine, parallel_workers
from conformodal.quality.advice import advice, describe_size, numbers, quality_record, verdict
from conformodal.quality.examining import examine

from .console import OUTPUT_PANEL, OptionError, Quiet, Verbose, print_where, progress_bars, report_line
from .sources import DATA_PANEL, AllData, Cache, DataLayout, Focal, cache_folder, open_sequences, was_given

_data, _model, _calibration = (
    partial(typer.Option, rich_help_panel=panel) for panel in (DATA_PANEL, "Model", "Calibration")
)
# Threads wait shorter for each other's Python code: with two on two cores, training takes 5 to 15 % less time
_SWITCH_S = 5e-4


def train(
    context: typer.Context,
    data: AllData,
    out: Annotated[Path, typer.Option(help="Folder to save the model in.", rich_help_panel=OUTPUT_PANEL)],
    cache: Cache = None,
    layout: DataLayout = Layout.AUTO,
    split: Annotated[SplitKind, _data(help="Held out: frames, stretches, recordings, lists.")] = ModelConfig.split,
    test: Annotated[str, _data(metavar="SHARE|DATA", help="Share held out, or a data set (--split given).")] = "0.2",
    seed: Annotated[int, _data(min=0, help="Of the split and of training.")] = 0,
    focal: Focal = None,
    trust_poses: Annotated[bool, _data("--trust-poses", help="Train although poses do not fit images.")] = False,
    method: Annotated[Method, _model(help="paper: the paper's system and values.")] = ModelConfig.method,
    sources: Annotated[str, _model(help="Pose sources, separated by commas.")] = ",".join(ModelConfig.sources),
    features: Annotated[str | None, _model(help="Local features: xfeat (where installed, default), orb.")] = None,
    network: Annotated[str, _model(help=f"Network of the features: {', '.join(NETWORKS)}.")] = ModelConfig.network,
    n_bins: Annotated[int, _model("--bins", min=1, help="Bins per target (K).")] = ModelConfig.n_bins,
    epochs: Annotated[int, _model(min=1, help="Passes over the training part.")] = TrainingConfig.epochs,
    alpha: Annotated[float, _calibration(help="Share of poses that regions may miss.")] = ModelConfig.alpha,
    joint: Annotated[str, _calibration(help="alpha is of max: whole poses; none: each number.")] = ModelConfig.joint,
    score: Annotated[str, _calibration(help="hpd, hpd_random, aps, density, lac (the paper's).")] = ModelConfig.score,
    calibrate_on: Annotated[
        Calibration, _calibration("--calibration", help="auto: frames for --split interleaved, else unseen stretches.")
    ] = ModelConfig.calibrate_on,
    workers: Annotated[int | None, _model(min=1, help="Processes that share folds: 1, or with ray all cores.")] = None,
    engine: Annotated[Engine, _model(help="Where workers are: here, or on a Ray cluster.")] = Engine.LOCAL,
    address: Annotated[str | None, _model(help="Of the Ray cluster; by default one that Ray finds or starts.")] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
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
    if address is not None and engine is not Engine.RAY:
        raise OptionError(f"--address needs --engine ray, got --engine {engine}")
    names = {field.name for field in fields(ModelConfig)}
    settings: dict[str, Any] = {name: value for name, value in context.params.items() if name in names - {"method"}}
    settings |= {"split": split, "test": share, "sources": tuple(name.strip() for name in sources.split(","))}
    settings["training"] = replace(TrainingConfig(), epochs=epochs, seed=seed)
    local = method is not Method.PAPER and any(find_source(name).local for name in settings["sources"])
    settings["features"] = features or (XFeatDetector.name if local else ModelConfig.features)
    if method is Method.PAPER:  # options that were left alone are the paper's then
        given, default = {name for name in settings if was_given(context, name)}, ModelConfig()
        given |= {name for name, value in settings.items() if value != getattr(default, name)}
        given -= {"calibrate_on"} if calibrate_on is Calibration.AUTO else set()
        config = ModelConfig.paper(**{name: settings[name] for name in given})
    else:
        config = ModelConfig(**settings)
    default_block(network)  # refuses a model of transformers that is not here, before images are read
    apart = [*data, *([] if held_out is None else [held_out])]
    with lock_output(out, "train", apart=apart), parallel_workers(workers, engine, address):
        feature_cache = FeatureCache(cache_folder(cache))
        sequence = open_sequences(data, layout, test=held_out, trust_poses=trust_poses, focal=focal)
        with progress_bars(out) as report:
            train_on(prepare_training_data(sequence, config, feature_cache, report), config, out, report)
    print_where(out)


def train_on(data: TrainingData, config: ModelConfig, out: Path, report: StageProgress) -> PoseModel:
    """Train, calibrate and save; prints what a user should know of the model."""
    started, sequence = time.perf_counter(), data.sequence
    sys.setswitchinterval(_SWITCH_S)
    model = train_model(data, config, progress=report)
    save_model(model, out)  # at the end: until then, a model that was there before is whole
    split = _split_record(model)
    quality = None
    if config.method is not Method.PAPER:  # whose system has no more to say
        quality = examine(sequence, model, just_trained=True, cache=data.cache)
    metrics = {
        "command": "train",
        "model": model_digest(out),
        "provenance": provenance(),
        "configuration": model.settings,
        "seed": config.seed,
        "split": split,
        "guarantee": describe_guarantee(model),
        "quality": None if quality is None else quality_record(quality),
        "seconds": round(time.perf_counter() - started, 2),
    }
    steps = [] if quality is None else advice(quality)
    summary = [
        f"coverage: {short_guarantee(model)}",
        f"size: {'see run' if quality is None else describe_size(quality)}",
        f"next: {steps[0] if steps else f'conformodal run {out} SOURCE --out OUT'}",
    ]
    write_metrics(out, {**metrics, "verdict": summary})
    for line in summary:
        report_line(line)
    report_detail = partial(report_line, detail=True)
    report_detail(
        f"{sequence.name}: {counted(split['train'], 'frame')} for training, {split['calibration']} for calibration, "
        f"{split['test']} held out for testing (split {split['kind']}, seed {split['seed']})"
    )
    copies = split["n_test_same_picture"] and (
        f"{split['n_test_same_picture']} of {counted(split['test'], 'test frame')} show the same picture as a training "
        "or calibration frame: their errors do not tell what to expect of new images"
    )
    for doubt in filter(None, (_doubt_landmarks(model), copies)):
        report_line(doubt, bold=True)
    report_detail(describe_guarantee(model))
    for line in [] if quality is None else [*numbers(quality), verdict(quality), *steps[1:]]:
        report_detail(line)
    return model


def _split_record(model: PoseModel) -> dict[str, Any]:
    """The parts of the data set for ``metrics.json``, and how many test frames are copies of others."""
    split, frames = model.split, model.known_frames
    used = frames.take(np.concatenate((split.train, split.calibration)))
    return {
        "kind": str(split.kind),
        "seed": split.seed,
        **{name: len(split.part(name)) for name in ("train", "calibration", "test")},
        "n_test_same_picture": int(used.known(frames.take(split.test)).sum()),
    }


def _doubt_landmarks(model: PoseModel) -> str:
    """Why there are no landmarks, or the camera is doubtful; else nothing."""
    if model.landmarks is None:
        asked = "landmarks" in model.settings["sources"]
        return "no landmarks: too few corners of the training frames could be triangulated" if asked else ""
    return doubt_focal(model.landmarks.map.camera.fx, model.camera)
