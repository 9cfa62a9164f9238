"""The demo's page: errors beside those of a regressor on the same features."""

from __future__ import annotations

from typing import Any

import numpy as np

from conformodal.core.words import counted, noun_for
from conformodal.odometry import Method
from conformodal.report import (
    PageFigure,
    ReportContent,
    Thumbnails,
    error_figure,
    make_viewer,
    plan_figure,
    trajectory_figure,
)

from .demo_outcome import DemoResults

_OURS, _PAPERS = "conformal, after reasoning", "the paper's greedy answer"


def error_ratio(errors: dict[str, dict[str, float]]) -> float:
    """Position RMSE of the classical regressor over that of the method."""
    return errors["classical"]["rmse_m"] / errors["greedy" if "greedy" in errors else "smoothed"]["rmse_m"]


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
    n_places = len(demo.alike.places[index]) + 1
    caption = f"{name}, from above. The image fits {counted(n_places, 'place')} equally well; " + (
        f"the region holds {int(demo.alike.held[index].sum())} of the other {n_places - 1}. Greedy reasoning chooses "
        "one of its cuboids, and goes on from there in the next frame, right or wrong."
        if paper
        else "the region names all, and motion through the corridor chooses among them. A regressor answers in "
        "between, where nothing is."
    )
    heading = "One frame's disjoint cuboids" if paper else "Here or there, not in between"
    bands = trajectory_figure(run, truth, run.trajectories["classical"], answer)
    bands_caption = "One band per interval. Where there are several at one time, the camera could be in any of them."
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
        _errors_said(outcome.metrics["errors"], paper),
        _places_said(outcome.metrics["ambiguity"]),
    ]
    return ReportContent(title, summary, outcome.metrics, figures, viewer, image)


def _flown(demo: DemoResults) -> str:
    split = demo.model.split
    return (
        f"A drone flew {counted(demo.n_laps, 'time')} along a dark hallway of "
        f"{counted(demo.world.n_modules, 'identical module')}, into every room. {counted(len(split.train), 'frame')} "
        f"trained a network, {len(split.calibration)} calibrated its regions, {len(demo.outcome.run.frames)} "
        f"{noun_for(len(demo.outcome.run.frames), 'was', 'were')} held out ({demo.outcome.metrics['split_note']})"
    )


def _errors_said(errors: dict[str, dict[str, float]], paper: bool) -> str:
    name, method = ("the paper's system, greedy reasoning included", "greedy") if paper else ("this method", "smoothed")
    return (
        f"Position RMSE of {name}: {errors[method]['rmse_m']:.3f} m. A classical regressor with the same features, "
        f"epochs and settings has {errors['classical']['rmse_m']:.2f} m ({error_ratio(errors):.2f} times)."
    )


def _places_said(record: dict[str, Any]) -> str:
    return (
        f"{counted(record['n_frames'], 'frame')} {noun_for(record['n_frames'], 'has', 'have')} other places with the "
        f"same view, {record['n_places']} in all; the regions hold {100 * record['share_held']:.1f} % of them."
    )


def _telling_frame(demo: DemoResults) -> int:
    """Of the frames with most look-alike places, all held, the one whose regressor is furthest from any of them."""
    truth, alike = demo.outcome.truth, demo.alike
    classical = demo.outcome.run.trajectories["classical"].positions_xyz
    counts = [len(p) if held.all() else -1 for p, held in zip(alike.places, alike.held, strict=True)]
    best, furthest = 0, -1.0
    for i in np.flatnonzero(np.array(counts) == max(counts)):
        places = np.concatenate((alike.places[i], truth.positions_xyz[i : i + 1]))
        distance = float(np.linalg.norm(places - classical[i], axis=1).min())
        if distance > furthest:
            best, furthest = int(i), distance
    return best
