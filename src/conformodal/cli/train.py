"""``conformodal train``: train, calibrate, save."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from conformodal.datasets import Layout, Sequence, SplitKind
from conformodal.experiments import opponents_training, save_classical, train_classical
from conformodal.odometry import (
    Landmarks,
    ModelConfig,
    PoseModel,
    prepare_training_data,
    provenance,
    save_model,
    train_model,
    write_metrics,
)
from conformodal.poses import PinholeCamera
from conformodal.vision import NETWORKS, FeatureCache, FineTuning, TrainingConfig, VisionError, default_cache_dir

from .console import Report, console, kind_errors, print_where, progress_bars
from .sources import open_sequence

_DEFAULT = ModelConfig()
_FOCAL_OFF = 0.02  # a focal length further off than that is worth a word


@kind_errors
def train(
    data: Annotated[Path, typer.Argument(help="Data set: images with poses.")],
    out: Annotated[Path, typer.Option(help="Folder to save the model in.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout of the data set.")] = Layout.AUTO,
    split: Annotated[
        SplitKind,
        typer.Option(
            help="How frames are held out: at random, in stretches, in whole recordings, or by the data set's lists."
        ),
    ] = _DEFAULT.split,
    alpha: Annotated[float, typer.Option(help="Miscoverage rate: the region may miss this share of poses.")] = (
        _DEFAULT.alpha
    ),
    joint: Annotated[str, typer.Option(help="bonferroni, max: alpha for the whole pose; none: for each target.")] = (
        _DEFAULT.joint
    ),
    score: Annotated[
        str, typer.Option(help="Nonconformity score: density, linear_density, aps, hpd, or lac as in the paper.")
    ] = _DEFAULT.score,
    bins: Annotated[int, typer.Option(help="Bins per target (K).")] = _DEFAULT.n_bins,
    sigma: Annotated[float, typer.Option(help="Width of the labels in bins; 0: one-hot, as in the paper.")] = (
        _DEFAULT.sigma_bins
    ),
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the training part.")] = _DEFAULT.training.epochs,
    dropout: Annotated[float, typer.Option(min=0, max=0.95, help="Share of features dropped in training.")] = (
        _DEFAULT.training.dropout
    ),
    test: Annotated[
        float, typer.Option(help="Share of all frames (or recordings) held out for testing.")
    ] = _DEFAULT.test,
    calibration: Annotated[float, typer.Option(help="Share of all frames (or recordings) held out to calibrate.")] = (
        _DEFAULT.calibration
    ),
    used: Annotated[
        float | None, typer.Option(help="Share of all frames for training and calibration together; all the rest.")
    ] = None,
    network: Annotated[str, typer.Option(help=f"Network of the features: {', '.join(NETWORKS)}.")] = _DEFAULT.network,
    fine_tune: Annotated[
        str, typer.Option(help="Also train the network: its last blocks (a number), 'all', or 'none'.")
    ] = "none",
    fine_tune_epochs: Annotated[int, typer.Option(min=1, help="Passes over the training images.")] = (
        FineTuning().epochs
    ),
    landmarks: Annotated[
        bool,
        typer.Option(help="Whether search and regions also rest on corners of training frames that are seen again."),
    ] = _DEFAULT.landmarks,
    device: Annotated[str, typer.Option(help="Of the network: cpu, cuda, or auto.")] = _DEFAULT.device,
    seed: Annotated[int, typer.Option(help="Of the split and of training.")] = 0,
    classical: Annotated[bool, typer.Option(help="Also train the classical regressor, to compare with.")] = False,
    cache: Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")] = None,
) -> None:
    """Train on a data set with poses, calibrate, and save the model."""
    config = ModelConfig(
        split=split,
        n_bins=bins,
        sigma_bins=sigma,
        alpha=alpha,
        score=score,
        joint=joint,
        test=test,
        calibration=calibration,
        used=used,
        network=network,
        landmarks=landmarks,
        fine_tuning=tuning_of(fine_tune, fine_tune_epochs, seed),
        device=device,
        seed=seed,
        training=replace(TrainingConfig(), epochs=epochs, dropout=dropout, seed=seed),
    )
    sequence = open_sequence(data, layout, require_poses=True)
    with progress_bars() as report:
        train_on(sequence, config, out, classical=classical, cache_dir=cache or default_cache_dir(), report=report)
    print_where(out)


def tuning_of(choice: str, epochs: int, seed: int) -> FineTuning | None:
    """What ``--fine-tune`` asks for.

    Raises
    ------
    VisionError
        If it is neither a number of blocks, nor ``all`` or ``none``.
    """
    if choice == "none":
        return None
    if choice == "all" or choice.isdecimal():
        return FineTuning(None if choice == "all" else int(choice), epochs, seed=seed)
    raise VisionError(f"--fine-tune must be a number of blocks, 'all' or 'none', got {choice!r}")


def said_of(landmarks: Landmarks | None, camera: PinholeCamera) -> str:
    """What a user should know of the landmarks."""
    if landmarks is None:
        return "no landmarks: too few corners of the training frames could be placed; search and regions do without"
    said = f"{landmarks.summary['n_landmarks']} landmarks of {landmarks.summary['n_keyframes']} frames"
    found, given = landmarks.map.camera.fx, camera.fx
    if abs(found / given - 1) > _FOCAL_OFF:
        said += (
            f"; the poses speak for a focal length of {found:.0f} px where {given:.0f} px is given: landmarks use the "
            "former, all else the latter"
        )
    return said


def train_on(
    sequence: Sequence, config: ModelConfig, out: Path, *, classical: bool, cache_dir: Path, report: Report
) -> PoseModel:
    """Train, calibrate and save; says what a user should know of the model."""
    started = time.perf_counter()
    data = prepare_training_data(sequence, config, FeatureCache(cache_dir), report)
    model = train_model(data, config, checkpoint_dir=cache_dir / "training", progress=report)
    save_model(model, out)
    if classical:
        save_classical(train_classical(data, opponents_training(config.training), report), out)
    split = model.split
    parts = {"train": len(split.train), "calibration": len(split.calibration), "test": len(split.test)}
    metrics = {
        "command": "train",
        "provenance": provenance(),
        "configuration": model.configuration,
        "seed": config.seed,
        "split": {"kind": str(split.kind), **parts},
        "landmarks": None if model.landmarks is None else model.landmarks.summary,
        "seconds": round(time.perf_counter() - started, 2),
    }
    write_metrics(out, metrics)
    console.print(
        f"{sequence.name}: {parts['train']} frames for training, {parts['calibration']} for calibration, "
        f"{parts['test']} held out for testing (split {split.kind}, seed {split.seed})"
    )
    if config.landmarks:
        console.print(said_of(model.landmarks, model.camera))
    if model.unbounded:
        console.print(
            f"[bold]The region is the whole space in some target:[/] {parts['calibration']} calibration frames are too "
            f"few for alpha = {config.alpha} ({config.joint}), or too many lie beyond the training range. Take a "
            "larger alpha or calibration share, or more frames."
        )
    return model
