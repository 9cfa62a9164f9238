"""The demo's answers, written to disk, and its page: errors beside those of a regressor on the same features."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.cli.outcome import GroundTruth, Part, part_frames, run_metrics
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, noun_for
from conformodal.corridor.ambiguity import AmbiguityCheck
from conformodal.corridor.world import CorridorWorld
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.evaluate import RegionStatistics, path_coverage_table
from conformodal.pipeline.model import ONLINE, PoseModel
from conformodal.pipeline.paper import odometry_of
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.results import write_run
from conformodal.pipeline.train import prepare_training_data
from conformodal.report.figures import plan_figure
from conformodal.report.page import PageFigure, ReportContent
from conformodal.report.viewer import Thumbnails, make_viewer


@dataclass(frozen=True, eq=False)
class Outcome:
    """Answers to the test part, the truth, and the content of ``metrics.json``."""

    run: OdometryRun
    truth: Trajectory
    metrics: dict[str, Any]
    records: list[dict[str, Any]]  # of the regions


def answer_test_part(
    model: PoseModel, config: ModelConfig, out: Path, sequence: Recording, report: StageProgress
) -> Outcome:
    """Answer the test part by a model, and by a regressor with the same features, epochs and settings."""
    frames = part_frames(model, sequence, Part.TEST)
    cache = FeatureCache(out / "cache")
    started = time.perf_counter()
    result = odometry_of(model).process(sequence, frames, progress=report)
    seconds = round(time.perf_counter() - started, 2)
    paths = [sequence.image_paths[i] for i in result.frames]
    features = extract_features(paths, model.backbone, cache)
    data = prepare_training_data(sequence, config, cache, report)
    classical = train_plain(data, config.training)
    result.trajectories["classical"] = classical.trajectory(features, result.timestamps_s)
    truth = sequence.require_truth()[result.frames]
    records = write_run(out, result, [path.name for path in paths], truth)
    counts = {
        "n_answered": len(result.frames),
        "n_unreliable": int(np.sum(~result.reliable)),
        "n_localized": sum(bool(its) for its in result.localization.beliefs.estimates),
        "n_unknown": int(np.sum(result.kinds == EvidenceType.UNKNOWN)),
        "n_without_image": len(result.unreadable),
        "problems": {str(k): v for k, v in result.unreadable.items()},
        "motion": dict(sorted(Counter(str(m.status) for m in result.motions if m is not None).items())),
        "stopped": "",
        "seconds": seconds,
    }
    sign, coverage = model.sign_reference, None
    if result.path_regions:
        on_path = {path: RegionStatistics.of(its, truth, sign) for path, its in result.path_regions.items()}
        coverage = path_coverage_table(on_path, model, result.trajectories[ONLINE], truth, result.reliable)
    known = GroundTruth(truth, RegionStatistics.of(result.regions, truth, sign, result.kinds), paths=coverage)
    metrics = run_metrics(model, Part.TEST, result.trajectories, known, counts)
    return Outcome(result, truth, metrics, records)


def describe_ratios(metrics: dict[str, Any]) -> str:
    """The last line on the terminal: the regressor's error over that of each method."""
    errors = metrics["errors"]
    regressor = errors["classical"]["rmse_m"]
    ratios = [f"{name} {regressor / row['rmse_m']:.2f}" for name, row in errors.items() if name != "classical"]
    return f"rmse_m of the classical regressor / of the method: {', '.join(ratios)} ({metrics['seconds']:.0f} s in all)"


def describe_places(record: dict[str, Any]) -> str:
    """How many places look the same, and how many of them the regions hold."""
    return (
        f"{counted(record['n_frames'], 'frame')} {noun_for(record['n_frames'], 'has', 'have')} other places with the "
        f"same view, {record['n_places']} in all; the regions hold {100 * record['share_held']:.1f} % of them."
    )


def page_of(
    outcome: Outcome, sequence: Recording, model: PoseModel, world: CorridorWorld, alike: AmbiguityCheck
) -> ReportContent:
    """The page of answers, with the plan of a frame that has most look-alike places, all of them held."""
    run, metrics = outcome.run, outcome.metrics
    paper = model.method is Method.PAPER
    index = int(np.argmax([len(p) if held.all() else -1 for p, held in zip(alike.places, alike.held, strict=True)]))
    name, there = sequence.image_paths[run.frames[index]].name, alike.places[index]
    answer, classical = (
        "the paper's greedy answer" if paper else "conformal, after reasoning",
        run.trajectories["classical"],
    )
    svg = plan_figure(run, index, outcome.truth, classical=classical, walls=world.plan(), alike=there, answer=answer)
    n = len(there)
    caption = (
        f"{name}, from above. {counted(n, 'other place')} {noun_for(n, 'has', 'have')} the same view: the region holds "
        f"{int(alike.held[index].sum())}."
    )
    pictures = Thumbnails()
    for i in run.frames.tolist():
        pictures.add(sequence.image_paths[i].name, sequence.image(i))
    split = model.split
    summary = [
        f"A drone flew along a dark hallway of {counted(world.n_modules, 'identical module')}, into every room. "
        f"{counted(len(split.train), 'frame')} trained a network, {len(split.calibration)} calibrated its regions, "
        f"{len(run.frames)} were held out ({metrics['split_note']})",
        describe_places(metrics["ambiguity"]),
    ]
    return ReportContent(
        "conformodal: a corridor of identical rooms" + (", by the paper's system" if paper else ""),
        summary,
        metrics,
        [PageFigure("plan", "One frame, and every place with the same view", caption, svg)],
        make_viewer(
            outcome.records,
            run.trajectories,
            outcome.truth,
            pictures.jpegs,
            model.rules.level,
            world.plan(),
        ),
    )
