"""``conformodal run``: a model on a source; trajectory, regions, metrics and a page."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.datasets import Layout, Sequence
from conformodal.experiments import (
    coverage_table,
    error_table,
    is_exchangeable,
    load_classical,
    motion_table,
    radius_table,
)
from conformodal.odometry import (
    OdometryError,
    OdometryRun,
    PoseModel,
    VisualOdometry,
    data_digest,
    load_model,
    provenance,
    write_metrics,
    write_run,
)
from conformodal.poses import Trajectory
from conformodal.report import PageFigure, ReportContent, error_figure, plan_figure, trajectory_figure, write_page
from conformodal.vision import FeatureCache, default_cache_dir, extract_features

from .console import Report, console, kind_errors, print_errors, print_where, progress_bars
from .sources import open_sequence


class Part(StrEnum):
    """Which frames of a source to answer."""

    ALL = "all"
    TRAIN = "train"
    CALIBRATION = "calibration"
    TEST = "test"


@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished run: what was found, the truth if known, and the content of ``metrics.json``."""

    run: OdometryRun
    truth: Trajectory | None
    metrics: dict[str, Any]


@kind_errors
def run(
    model: Annotated[Path, typer.Argument(help="Folder of a saved model.")],
    source: Annotated[Path, typer.Argument(help="Frames: a folder in the given layout, with or without poses.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout of the source.")] = Layout.AUTO,
    part: Annotated[Part, typer.Option(help="Frames to answer: all, or a part of the model's own data set.")] = (
        Part.ALL
    ),
    alpha: Annotated[float | None, typer.Option(help="Another miscoverage rate than the model was saved with.")] = None,
    cache: Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")] = None,
) -> None:
    """Find regions and the trajectory of a source with a saved model."""
    loaded = load_model(model)
    if alpha is not None:
        loaded.recalibrate(alpha)
    sequence = open_sequence(source, layout, require_poses=False)
    cache_dir = cache or default_cache_dir()
    with progress_bars() as report:
        outcome = run_on(loaded, model, sequence, part, out, cache_dir=cache_dir, report=report)
    write_page(out / "report.html", page_of(outcome, sequence, f"conformodal: {sequence.name}"))
    say(outcome)
    print_where(out)


def run_on(
    model: PoseModel,
    model_dir: Path,
    sequence: Sequence,
    part: Part,
    out: Path,
    *,
    cache_dir: Path,
    report: Report,
) -> Outcome:
    """Run a model, and the classical regressor if one is beside it; write everything but the page.

    Raises
    ------
    OdometryError
        If a part is asked of another data set than the model's.
    """
    frames = _frames(model, sequence, part)
    cache = FeatureCache(cache_dir)
    started = time.perf_counter()
    result = VisualOdometry(model).process(sequence, frames, cache=cache, progress=report)
    seconds = time.perf_counter() - started
    classical = load_classical(model_dir)
    if classical is not None:
        paths = [sequence.image_paths[i] for i in result.frames]
        features = extract_features(paths, model.backbone, cache, noise=sequence.noise)
        result.trajectories |= classical.trajectories(features, result, sequence.recording[result.frames], model.prior)
    truth = None if sequence.truth is None else sequence.truth[result.frames]
    write_run(out, result, [sequence.image_paths[i].name for i in result.frames], truth)
    metrics: dict[str, Any] = {
        "command": "run",
        "provenance": provenance(),
        "configuration": {**model.configuration, "alpha": float(model.calibration.alpha), "part": str(part)},
        "seed": model.split.seed,
        "split": str(model.split.kind),
        "split_note": _split_note(model, part),
        "sign_reference_quat_wxyz": model.sign_reference.tolist(),
        "n_answered": len(result.frames),
        "n_unreliable": int(np.sum(~result.reliable)),
        "unreadable": {str(k): v for k, v in result.unreadable.items()},
        "motion": motion_table(result),
        "seconds": round(seconds, 2),
    }
    if classical is not None:
        metrics["classical_training"] = asdict(classical.training)
    # whole recordings calibrated it: some of a recording's frames alone are answered otherwise, and it says nothing
    metrics["radius"] = radius_table(model.radius if part is Part.ALL else None, result, truth)
    if truth is not None:
        metrics["errors"] = error_table(result.trajectories, truth)
        metrics["coverage"] = coverage_table(result, truth, model, exchangeable=is_exchangeable(model, str(part)))
    write_metrics(out, metrics)
    return Outcome(result, truth, metrics)


def page_of(outcome: Outcome, sequence: Sequence, title: str) -> ReportContent:
    """The page's standard content: bands, one frame's regions, errors."""
    run, truth = outcome.run, outcome.truth
    classical = run.trajectories.get("classical")
    index = int(np.argmax(run.regions.n_intervals[:, :3].prod(axis=1)))
    counts = " x ".join(str(k) for k in run.regions.n_intervals[index, :3])
    name = sequence.image_paths[run.frames[index]].name
    caption = "One band per interval. Where there are several at one time, the camera could be in any of them."
    bands = trajectory_figure(run, truth, classical)
    figures = [PageFigure("trajectory", "Trajectory with its region", caption, bands)]
    first, second = sorted(np.argsort(-np.ptp(run.trajectory.positions_xyz, axis=0))[:2].tolist())
    plan = plan_figure(run, index, truth, classical=classical, axes=(first, second))
    text = f"{name}: {counts} intervals in x, y, z, the most of all frames. The axes are the two it moves most along."
    figures.append(PageFigure("plan", "The region of one frame", text, plan))
    if truth is not None:
        text = "Share of frames whose position error is below a value."
        svg = error_figure(run.trajectories, truth)
        figures.append(PageFigure("errors", "Errors of all frames", text, svg))
    summary = [
        f"{sequence.name}: {len(run.frames)} frames answered, {outcome.metrics['split_note']}",
        f"{outcome.metrics['n_unreliable']} frames without reliable motion, {len(run.unreadable)} unreadable.",
    ]
    radius = outcome.metrics["radius"]
    if radius is not None:
        summary.append(f"The {radius['method']} pose has a radius of {_size(radius)}. {radius['assumption']}")
    image = (name, sequence.image(int(run.frames[index])))
    return ReportContent(title, summary, outcome.metrics, figures, image)


def say(outcome: Outcome) -> None:
    """The result on the terminal."""
    metrics, run = outcome.metrics, outcome.run
    unreadable = f", {len(run.unreadable)} unreadable" if run.unreadable else ""
    console.print(f"{metrics['n_answered']} frames, {metrics['n_unreliable']} without reliable motion{unreadable}")
    if run.regions.unbounded.any():
        console.print("[bold]The region is the whole space in some target[/]: too few calibration frames for alpha.")
    if metrics["radius"] is not None:
        console.print(f"radius of the {metrics['radius']['method']} pose: {_size(metrics['radius'])}")
    if "errors" in metrics:
        print_errors(metrics["errors"], metrics["split_note"])
        coverage = metrics["coverage"]
        console.print(
            f"whole pose covered {coverage['joint_coverage']:.3f}, alpha = {coverage['alpha']} ({coverage['joint']}). "
            + coverage["assumption"],
            soft_wrap=True,
        )


def _size(radius: dict[str, Any]) -> str:
    if radius["radius_m"] is None or radius["radius_deg"] is None:
        return "infinity, for want of recordings to calibrate it on"
    return f"{radius['radius_m']:.4f} m and {radius['radius_deg']:.2f} degrees"


def _frames(model: PoseModel, sequence: Sequence, part: Part) -> np.ndarray | None:
    if part is Part.ALL:
        return None
    if data_digest(sequence) != model.data_digest:
        raise OdometryError(
            f"{sequence.name}: is not the data set the model was trained on ({model.configuration['data']}), so it has "
            f"no {part} part; run on all of it"
        )
    return model.split.part(str(part))


def _split_note(model: PoseModel, part: Part) -> str:
    if part is Part.ALL:
        return "all frames of the source (parts of the training data among them, if it is the same)."
    return f"the {part} part of split {model.split.kind}, seed {model.split.seed}."
