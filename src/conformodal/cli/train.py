"""``conformodal train``: the options of training."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.core.extras import require_extra
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import NETWORKS, TrainingConfig
from conformodal.io import Layout, SplitKind
from conformodal.pipeline.config import Calibration, Method, ModelConfig
from conformodal.pipeline.results import lock_output

from .console import print_where, progress_bars
from .failures import OptionError, report_errors
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
from .training import train_on

_data, _model, _calibration = (
    partial(typer.Option, rich_help_panel=panel) for panel in (DATA_PANEL, "Model", "Calibration")
)


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
    calibration: Annotated[
        float, _data("--calibration-share", help="Share of all frames (or recordings) held out to calibrate.")
    ] = ModelConfig.calibration,
    used: Annotated[float | None, _data(help="Share of all frames for training and calibration together.")] = None,
    focal: Focal = None,
    follow_outside: FollowOutside = False,
    sources: Annotated[str, _model(help="Pose sources of the belief, in order, separated by commas.")] = (
        ",".join(ModelConfig.sources)
    ),
    network: Annotated[str, _model(help=f"Network of the features: {', '.join(NETWORKS)}.")] = ModelConfig.network,
    n_bins: Annotated[int, _model("--bins", min=1, help="Bins per target (K).")] = ModelConfig.n_bins,
    sigma_bins: Annotated[
        float, _model("--sigma", min=0, help="Width of the labels in bins; 0: one-hot, as in the paper.")
    ] = (ModelConfig.sigma_bins),
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
    calibrate_on: Annotated[
        Calibration,
        _calibration(
            "--calibration",
            help="What the regions are calibrated on. frames: the calibration part. stretches: stretches (or "
            "recordings) of training and calibration part, each answered by sources that did not see it. auto: frames "
            "for --split interleaved, else stretches.",
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
        "n_bins": n_bins,
        "sigma_bins": sigma_bins,
        "alpha": alpha,
        "score": score,
        "joint": joint,
        "test": share,
        "calibration": calibration,
        "calibrate_on": calibrate_on,
        "novelty_level": novelty_level,
        "used": used,
        "network": network,
        "sources": tuple(name.strip() for name in sources.split(",")),
        "seed": seed,
        "training": replace(TrainingConfig(), epochs=epochs, dropout=dropout, seed=seed),
    }
    if method is Method.PAPER:  # options that were left alone are the paper's then
        given, default = {name for name in settings if was_given(context, name)}, ModelConfig()
        given |= {name for name, value in settings.items() if value != getattr(default, name)}
        given -= {"calibrate_on"} if calibrate_on is Calibration.AUTO else set()
        config = ModelConfig.paper(**{name: settings[name] for name in given})
    else:
        config = ModelConfig(**settings)
    with require_extra("train", "training"):  # torch takes a second to import
        from conformodal.features.networks import default_block  # noqa: PLC0415

    default_block(network)  # refuses a model of transformers that is not here, before images are read
    with lock_output(out, "train", apart=[*data, *([] if held_out is None else [held_out])]):
        features = FeatureCache(cache_folder(cache))
        sequence = open_sequences(data, layout, test=held_out, follow_outside=follow_outside, focal=focal)
        with progress_bars(out) as report:
            train_on(sequence, config, out, features=features, report=report)
    print_where(out)
