"""``conformodal extend``: add recordings to a trained model."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.io import DatasetWarning, Layout
from conformodal.pipeline.extending import extend_model
from conformodal.pipeline.results.folders import lock_output
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.results.runs import write_metrics
from conformodal.pipeline.store import load_model, model_digest, save_model
from conformodal.quality.advice import describe_guarantee
from conformodal.quality.guarantee import guarantees

from .console import print_where, progress_bars, report_errors, report_line, report_strongly, warning_lines
from .model_notes import describe_landmarks
from .sources import AllData, Cache, DataLayout, FollowOutside, SavedModel, cache_folder, open_sequences


@report_errors
def extend(
    model: SavedModel,
    data: AllData,
    out: Annotated[
        Path | None, typer.Option(help="Folder to save the extended model in; by default it replaces the model.")
    ] = None,
    layout: DataLayout = Layout.AUTO,
    check_world: Annotated[
        bool,
        typer.Option(help="Compare the world frames where the map recognises images; off for places that look alike."),
    ] = True,
    follow_outside: FollowOutside = False,
    cache: Cache = None,
) -> None:
    """Add recordings to a model without the images that it was trained on, and calibrate again."""
    started, out = time.perf_counter(), out or model
    with lock_output(out, "train", apart=data):
        known, features = load_model(model), FeatureCache(cache_folder(cache))
        sequence = open_sequences(data, layout, require_poses=True, follow_outside=follow_outside)
        with warning_lines(DatasetWarning, report_strongly), progress_bars(out) as report:
            extended = extend_model(known, sequence, features, report, check_world=check_world)
        before = model_digest(model)
        save_model(extended, out)
        first, split, comparison = len(known.known_frames), extended.split, extended.comparison
        added = {name: int((split.part(name) >= first).sum()) for name in ("train", "calibration", "test")}
        metrics = {
            "command": "train",
            "model": model_digest(out),
            "extended_from": before,
            "provenance": provenance(),
            "configuration": extended.settings,
            "added": added,
            "source_comparison": None if comparison is None else asdict(comparison),
            "landmarks": None if extended.landmarks is None else extended.landmarks.summary,
            "seconds": round(time.perf_counter() - started, 2),
        }
        write_metrics(out, metrics)
    report_line(
        f"{sequence.name}: {counted(added['train'] + added['calibration'], 'frame')} added, {added['test']} held out "
        f"for testing; the model knows {first} frames of {known.configuration['data']} too"
    )
    if extended.landmarks is not None:
        report_line(describe_landmarks(extended.landmarks, extended.camera))
    if comparison is not None:
        report_line(comparison.describe())
    for guarantee in guarantees(extended):
        report_line(describe_guarantee(guarantee))
    if known.radius is not None:
        report_strongly("The radius was of the model as it was: calibrate it again (conformodal calibrate).")
    print_where(out)
