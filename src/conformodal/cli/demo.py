"""``conformodal demo``: the whole story on the corridor world."""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal._files import FolderError, write_whole
from conformodal.datasets import Sequence, read_sevenscenes
from conformodal.datasets.corridor import CorridorWorld, Renderer, write_corridor
from conformodal.experiments import AmbiguityCheck, check_ambiguity, load_classical
from conformodal.odometry import (
    Evidence,
    ModelConfig,
    OdometryRun,
    PoseModel,
    RegionTally,
    VisualOdometry,
    write_metrics,
    write_run,
)
from conformodal.odometry.folders import check_no_stray, claimed
from conformodal.poses import Trajectory
from conformodal.report import (
    PageFigure,
    ReportContent,
    Thumbnails,
    error_figure,
    make_viewer,
    plan_figure,
    trajectory_figure,
    write_page,
)
from conformodal.vision import FeatureCache, TrainingConfig, extract_features

from .console import Report, console, kind_errors, print_where, progress_bars
from .outcome import Known, Part, part_frames, run_metrics, say
from .train import train_on

N_MODULES, N_LAPS = 5, 2
# Strong dropout: in a world made of copies, a network that remembers frames tells copies apart by chance details. All
# features, not their principal components: rooms differ in small things.
TRAINING = TrainingConfig(epochs=40, dropout=0.6, components=None)
ALPHA = 0.02


@kind_errors
def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(help="Of world, flight, split and training.")] = 0,
) -> None:
    """Fly through a corridor of identical rooms, learn it, and find the way by conformal regions and motion."""
    started = time.perf_counter()
    config = ModelConfig(alpha=ALPHA, seed=seed, training=replace(TRAINING, seed=seed))
    with claimed(out, "demo"), progress_bars() as report:
        check_no_stray(out, "demo")
        sequence = _corridor(out / "corridor", seed, report)
        model = train_on(sequence, config, out / "model", classical=True, cache_dir=out / "cache", report=report)
        outcome = _answer(model, out, sequence, report)
        world = CorridorWorld(N_MODULES, seed=seed)
        alike = check_ambiguity(
            outcome.run,
            outcome.truth,
            model,
            Renderer(world),
            progress=lambda done, total: report("look-alikes", done, total),
        )
        outcome.metrics["ambiguity"] = _ambiguity_record(alike)
        outcome.metrics["command"] = "demo"
        outcome.metrics["seconds"] = round(time.perf_counter() - started, 2)
        write_metrics(out, outcome.metrics)
        write_page(out / "report.html", _page(outcome, sequence, model, world, alike, out))
    say(outcome.metrics, whole_space=outcome.metrics["coverage"]["whole_space"])
    record = outcome.metrics["ambiguity"]
    console.print(
        f"{record['n_frames']} frames have other places with the same view, {record['n_places']} in all; the regions "
        f"hold {record['share_held']:.3f} of them (whole pose)"
    )
    ratio = outcome.metrics["errors"]["classical"]["rmse_m"] / outcome.metrics["errors"]["smoothed"]["rmse_m"]
    console.print(f"classical / conformal rmse_m: {ratio:.1f}   ({outcome.metrics['seconds']:.0f} s in all)")
    console.print(f"open {(out / 'report.html').resolve()}", soft_wrap=True)
    print_where(out)


def _corridor(place: Path, seed: int, report: Report) -> Sequence:
    """The flight of a seed; one that an earlier demo wrote is not written again."""
    mark, flight, old = place / "demo.json", place / "seq-01", place / ".old"
    wanted, found = {"seed": seed, "n_modules": N_MODULES, "n_laps": N_LAPS}, None
    if place.exists() and not mark.is_file() and (not place.is_dir() or any(place.iterdir())):
        raise FolderError(f"{place}: was not written by demo, which would overwrite it; take another folder")
    with suppress(OSError, ValueError):
        found = json.loads(mark.read_text(encoding="utf-8"))
    shutil.rmtree(old, ignore_errors=True)
    if found != wanted and flight.exists():
        flight.rename(old)  # gone by that name at once: never half a flight under the mark of a whole one
    write_whole(mark, json.dumps(wanted) + "\n")
    shutil.rmtree(old, ignore_errors=True)
    if not flight.is_dir():
        write_corridor(
            place,
            n_modules=N_MODULES,
            n_laps=N_LAPS,
            seed=seed,
            progress=lambda done, total: report("corridor", done, total),
        )
    return read_sevenscenes(place)


@dataclass(frozen=True, eq=False)
class _Outcome:
    run: OdometryRun
    truth: Trajectory
    metrics: dict[str, Any]


def _answer(model: PoseModel, out: Path, sequence: Sequence, report: Report) -> _Outcome:
    """The test part with all methods, written to disk."""
    frames = part_frames(model, sequence, Part.TEST)
    cache = FeatureCache(out / "cache")
    started = time.perf_counter()
    result = VisualOdometry(model).process(sequence, frames, cache=cache, progress=report)
    seconds = round(time.perf_counter() - started, 2)
    classical = load_classical(out / "model")
    assert classical is not None
    paths = [sequence.image_paths[i] for i in result.frames]
    features = extract_features(paths, model.backbone, cache)
    result.trajectories |= classical.trajectories(features, result, sequence.recording[result.frames], model.prior)
    truth = sequence.require_truth()[result.frames]
    write_run(out, result, [path.name for path in paths], truth, "demo")
    counts = {
        "n_answered": len(result.frames),
        "n_unreliable": int(np.sum(~result.reliable)),
        "n_fixed": sum(bool(fixes.search) for fixes in result.fixes),
        "n_unknown": int(np.sum(result.kinds == Evidence.UNKNOWN)),
        "n_without_image": len(result.unreadable),
        "problems": {str(k): v for k, v in result.unreadable.items()},
        "motion": dict(sorted(Counter(str(m.status) for m in result.motions if m is not None).items())),
        "stopped": "",
        "seconds": seconds,
    }
    known = Known(truth, RegionTally.of(result.regions, truth, model.sign_reference, result.kinds))
    metrics = run_metrics(model, classical, Part.TEST, result.trajectories, known, counts)
    return _Outcome(result, truth, metrics)


def _ambiguity_record(check: AmbiguityCheck) -> dict[str, Any]:
    return {
        "n_frames": check.n_frames,
        "n_places": check.n_places,
        "share_held": check.share_held,
        "share_held_position": check.share_held_position,
    }


def _page(
    outcome: _Outcome,
    sequence: Sequence,
    model: PoseModel,
    world: CorridorWorld,
    alike: AmbiguityCheck,
    folder: Path,
) -> ReportContent:
    """The page, with the plan of a frame that has several look-alike places and all of them held."""
    run, truth = outcome.run, outcome.truth
    index = _telling_frame(outcome, truth, alike)
    name = sequence.image_paths[run.frames[index]].name
    svg = plan_figure(
        run,
        index,
        truth,
        classical=run.trajectories.get("classical"),
        walls=world.plan(),
        alike=alike.places[index],
    )
    caption = (
        f"{name}, from above. The image fits {len(alike.places[index]) + 1} places equally well; the region names all, "
        "and motion through the corridor chooses among them. A regressor answers in between, where nothing is."
    )
    bands = trajectory_figure(run, truth, run.trajectories["classical"])
    bands_caption = "One band per interval. Where there are several at one time, the camera could be in any of them."
    errors_caption = "Share of frames whose position error is below a value."
    figures = [
        PageFigure("plan", "Here or there, not in between", caption, svg),
        PageFigure("trajectory", "Trajectory with its region", bands_caption, bands),
        PageFigure("errors", "Errors of all frames", errors_caption, error_figure(run.trajectories, truth)),
    ]
    errors, record = outcome.metrics["errors"], outcome.metrics["ambiguity"]
    ratio = errors["classical"]["rmse_m"] / errors["smoothed"]["rmse_m"]
    summary = [
        f"A drone flew {N_LAPS} times along a dark hallway of {world.n_modules} identical modules, into every room. "
        f"{len(model.split.train)} frames trained a network, {len(model.split.calibration)} calibrated its regions, "
        f"{len(run.frames)} were held out ({outcome.metrics['split_note']})",
        f"Position RMSE: {errors['smoothed']['rmse_m']:.3f} m, against {errors['classical']['rmse_m']:.2f} m for a "
        f"regressor on the same features ({ratio:.0f} times).",
        f"{record['n_frames']} frames have other places with the same view; the regions hold "
        f"{100 * record['share_held']:.1f} % of these {record['n_places']} places.",
    ]
    image = (f"{name}: which room is this?", sequence.image(int(run.frames[index])))
    pictures = Thumbnails()
    for i in run.frames.tolist():
        pictures.add(sequence.image_paths[i].name, sequence.image(i))
    viewer = make_viewer(folder, pictures.kept, model.rules.level)
    title = "conformodal: a corridor of identical rooms"
    return ReportContent(title, summary, outcome.metrics, figures, viewer, image)


def _telling_frame(outcome: _Outcome, truth: Trajectory, alike: AmbiguityCheck) -> int:
    """Of the frames with most look-alike places, all held, the one whose regressor is furthest from any of them."""
    classical = outcome.run.trajectories["classical"].positions_xyz
    counts = [len(p) if held.all() else -1 for p, held in zip(alike.places, alike.held, strict=True)]
    best, furthest = 0, -1.0
    for i in np.flatnonzero(np.array(counts) == max(counts)):
        places = np.concatenate((alike.places[i], truth.positions_xyz[i : i + 1]))
        distance = float(np.linalg.norm(places - classical[i], axis=1).min())
        if distance > furthest:
            best, furthest = int(i), distance
    return best
