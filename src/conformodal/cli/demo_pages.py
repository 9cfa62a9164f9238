"""The demo's answers, written to disk, and its page: errors beside those of a regressor on the same features."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import BoolArray
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, noun_for
from conformodal.datasets import Sequence
from conformodal.datasets.corridor.world import CorridorWorld
from conformodal.model.config import Method, ModelConfig
from conformodal.model.model import PoseModel
from conformodal.model.region_rules import EvidenceType
from conformodal.poses import Trajectory
from conformodal.quality.corridor_ambiguity import AmbiguityCheck
from conformodal.report.figures import error_figure, plan_figure, trajectory_figure
from conformodal.report.page import PageFigure, ReportContent
from conformodal.report.thumbnails import Thumbnails
from conformodal.report.viewer import make_viewer
from conformodal.running.estimates import OdometryRun
from conformodal.running.paper_odometry import odometry_of
from conformodal.running.paths import METHODS, ONLINE
from conformodal.running.results.evaluation import path_coverage_table
from conformodal.running.results.runs import write_run
from conformodal.running.results.statistics import RegionStatistics
from conformodal.training.plain import train_plain
from conformodal.training.training import prepare_training_data
from conformodal.vision.features import FeatureCache, extract_features

from .outcome import GroundTruth, Part, part_frames, run_metrics

_OURS, _PAPERS = "conformal, after reasoning", "the paper's greedy answer"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Answers to the test part, the truth, and the content of ``metrics.json``."""

    run: OdometryRun
    truth: Trajectory
    metrics: dict[str, Any]


@dataclass(frozen=True, eq=False)
class DemoResults:
    """Everything that the demo's page shows.

    Attributes
    ----------
    outcome, sequence, model
        The answers to the test part, the flight, and the model that answered.
    world, n_laps
        The corridor, and how often the camera flew through it.
    alike
        Places with the same view.
    folder
        Where the answers are.
    """

    outcome: Outcome
    sequence: Sequence
    model: PoseModel
    world: CorridorWorld
    alike: AmbiguityCheck
    n_laps: int
    folder: Path


def answer_test_part(
    model: PoseModel, config: ModelConfig, out: Path, sequence: Sequence, report: StageProgress
) -> Outcome:
    """Answer the test part by a model, and by a regressor with the same features, epochs and settings."""
    frames = part_frames(model, sequence, Part.TEST)
    cache = FeatureCache(out / "cache")
    started = time.perf_counter()
    result = odometry_of(model).process(sequence, frames, cache=cache, progress=report)
    seconds = round(time.perf_counter() - started, 2)
    paths = [sequence.image_paths[i] for i in result.frames]
    features = extract_features(paths, model.backbone, cache)
    data = prepare_training_data(sequence, config, cache, report)
    classical = train_plain(data, config.training)
    result.trajectories["classical"] = classical.trajectory(features, result.timestamps_s)
    truth = sequence.require_truth()[result.frames]
    write_run(out, result, [path.name for path in paths], truth, "demo")
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
    sign = model.sign_reference
    on_path = {path: RegionStatistics.of(its, truth, sign) for path, its in result.path_regions.items()}
    coverage = None
    if on_path:
        coverage = path_coverage_table(on_path, model, result.trajectories[ONLINE], truth, result.reliable)
    its = RegionStatistics.of(result.regions, truth, sign, result.kinds)
    known = GroundTruth(truth, its, paths=coverage)
    metrics = run_metrics(model, Part.TEST, result.trajectories, known, counts)
    return Outcome(result, truth, metrics)


def describe_ratios(method: Method, metrics: dict[str, Any]) -> str:
    """The last line on the terminal: ratios of errors."""
    errors = metrics["errors"]
    took = f"({metrics['seconds']:.0f} s in all)"
    if method is Method.CONFORMODAL:
        ratios = [errors["classical"]["rmse_m"] / errors[name]["rmse_m"] for name in (ONLINE, METHODS[0])]
        return f"classical / conformal rmse_m: online {ratios[0]:.1f}, with hindsight {ratios[1]:.1f}   {took}"
    return f"classical / paper's system rmse_m: {_over(errors):.2f}; below 1 the regressor is the better one   {took}"


def page_of(demo: DemoResults) -> ReportContent:
    """The page, with the plan of a frame that has several look-alike places, and all of them held if there is one."""
    outcome, sequence = demo.outcome, demo.sequence
    run, truth = outcome.run, outcome.truth
    paper = demo.model.method is Method.PAPER
    index = _telling_frame(demo)
    name = sequence.image_paths[run.frames[index]].name
    answer = _PAPERS if paper else _OURS
    svg = plan_figure(
        run,
        index,
        truth,
        classical=run.trajectories["classical"],
        walls=demo.world.plan(),
        alike=demo.alike.places[index],
        answer=answer,
    )
    caption = f"{name}, from above. {count_places(demo, index)}" + (
        " Greedy reasoning chooses one of its cuboids, and goes on from there in the next frame." if paper else ""
    )
    heading = "One frame's disjoint cuboids" if paper else "One frame, and every place with the same view"
    bands = trajectory_figure(run, truth, run.trajectories["classical"], answer)
    bands_caption = (
        "One band per interval. Several at one time: the region names more than one place, and the line is the choice."
    )
    errors_caption = "Share of frames whose position error is below a value."
    figures = [
        PageFigure("plan", heading, caption, svg),
        PageFigure("trajectory", "Trajectory with its region", bands_caption, bands),
        PageFigure("errors", "Errors of all frames", errors_caption, error_figure(run.trajectories, truth)),
    ]
    image = (f"{name}: which room is this?", sequence.image(int(run.frames[index])))
    pictures = Thumbnails()
    for i in run.frames.tolist():
        pictures.add(sequence.image_paths[i].name, sequence.image(i))
    viewer = make_viewer(demo.folder, pictures.kept, demo.model.rules.level, demo.world.plan())
    title = "conformodal: a corridor of identical rooms" + (", by the paper's system" if paper else "")
    summary = [
        _flown(demo),
        _describe_errors(outcome.metrics["errors"], paper),
        _describe_places(outcome.metrics["ambiguity"]),
    ]
    return ReportContent(title, summary, outcome.metrics, figures, viewer, image)


def count_places(demo: DemoResults, index: int) -> str:
    """What is seen in the plan of a frame, and how often it is so in this run."""
    run, truth, alike = demo.outcome.run, demo.outcome.truth, demo.alike
    n = len(alike.places[index])
    if not n:
        return "No other place has the same view."
    right, off = true_place_chosen(run.trajectory, truth, alike), _regressor_off_m(demo, index)
    several = np.array([len(places) > 0 for places in alike.places])
    held, all_held = int(alike.held[index].sum()), sum(bool(h.all()) for h in alike.held if len(h))
    return (
        f"{counted(n, 'other place')} {noun_for(n, 'has', 'have')} the same view: the region holds {held}. The chosen "
        f"pose is nearest to {'the true place' if right[index] else 'a wrong one'}; the regressor's answer is "
        f"{off:.2f} m from the nearest of these places. Of {counted(int(several.sum()), 'frame')} with such places, "
        f"the region holds all of them in {all_held}, and the chosen pose is nearest to the true one in "
        f"{int(right[several].sum())}."
    )


def true_place_chosen(chosen: Trajectory, truth: Trajectory, alike: AmbiguityCheck) -> BoolArray:
    """(n,) whether each chosen pose is nearer to its true place than to any other place with the same view."""
    off = np.linalg.norm(chosen.positions_xyz - truth.positions_xyz, axis=1)
    others = [
        np.linalg.norm(places - place, axis=1).min(initial=np.inf)
        for places, place in zip(alike.places, chosen.positions_xyz, strict=True)
    ]
    return np.asarray(off <= np.array(others))


def _regressor_off_m(demo: DemoResults, index: int) -> float:
    """From the regressor's answer to the nearest of the places that a frame may show."""
    answer = demo.outcome.run.trajectories["classical"].positions_xyz[index]
    places = np.concatenate((demo.alike.places[index], demo.outcome.truth.positions_xyz[index : index + 1]))
    return float(np.linalg.norm(places - answer, axis=1).min())


def _flown(demo: DemoResults) -> str:
    split = demo.model.split
    return (
        f"A drone flew {counted(demo.n_laps, 'time')} along a dark hallway of "
        f"{counted(demo.world.n_modules, 'identical module')}, into every room. {counted(len(split.train), 'frame')} "
        f"trained a network, {len(split.calibration)} calibrated its regions, {len(demo.outcome.run.frames)} "
        f"{noun_for(len(demo.outcome.run.frames), 'was', 'were')} held out ({demo.outcome.metrics['split_note']})"
    )


def _describe_errors(errors: dict[str, dict[str, float]], paper: bool) -> str:
    if not paper:
        return (
            f"Position RMSE: {errors[ONLINE]['rmse_m']:.3f} m when a frame comes, {errors[METHODS[0]]['rmse_m']:.3f} m "
            f"with hindsight, against {errors['classical']['rmse_m']:.2f} m for a regressor on the same features."
        )
    return (
        f"Position RMSE of the paper's system, greedy reasoning included: {errors['greedy']['rmse_m']:.3f} m. A "
        f"regressor with the same features, epochs and settings has {errors['classical']['rmse_m']:.2f} m "
        f"({_over(errors):.2f} times)."
    )


def _over(errors: dict[str, dict[str, float]]) -> float:
    """The regressor's error over that of the paper's system."""
    return errors["classical"]["rmse_m"] / errors["greedy"]["rmse_m"]


def _describe_places(record: dict[str, Any]) -> str:
    return (
        f"{counted(record['n_frames'], 'frame')} {noun_for(record['n_frames'], 'has', 'have')} other places with the "
        f"same view, {record['n_places']} in all; the regions hold {100 * record['share_held']:.1f} % of them."
    )


def _telling_frame(demo: DemoResults) -> int:
    """Of the frames with most look-alike places, all held, the one whose regressor is furthest from any of them."""
    alike = demo.alike
    counts = [len(p) if held.all() else -1 for p, held in zip(alike.places, alike.held, strict=True)]
    best, furthest = 0, -1.0
    for i in np.flatnonzero(np.array(counts) == max(counts)):
        distance = _regressor_off_m(demo, int(i))
        if distance > furthest:
            best, furthest = int(i), distance
    return best
