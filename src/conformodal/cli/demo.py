"""``conformodal demo``: make the corridor world, train in it, answer the test frames, write the page."""

from __future__ import annotations

import json
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.files import write_whole
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted, noun_for
from conformodal.corridor.ambiguity import AmbiguityCheck, check_ambiguity
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.corridor.writer import write_corridor
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory
from conformodal.io import Recording, read_recording
from conformodal.io.folders import FolderError
from conformodal.io.pose_files import write_tum
from conformodal.io.streams.frames import Frame
from conformodal.io.streams.stored import RecordingStream
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.train import prepare_training_data
from conformodal.report.figures import plan_figure
from conformodal.report.page import PAGE, PageFigure

from .answering import Answers, Part, answer_stream, metrics_of, part_frames, write_answers
from .console import print_where, progress_bars, report_line
from .failures import report_errors
from .outcome import describe_outcome, report_outcome
from .train import train_on

N_MODULES, N_LAPS = 5, 2
# Strong dropout: in a world made of copies, a network that remembers frames tells copies apart by chance details. All
# features, not their principal components: rooms differ in small things.
TRAINING = TrainingConfig(epochs=40, dropout=0.6, components=None)
ALPHA = 0.02
_PAPERS_ALPHA = 0.1  # the paper's example, of each target


@dataclass(eq=False)
class _AnsweredFrames:
    """The frames of a stream that were answered, and their regions."""

    frames: list[int] = field(default_factory=list)
    regions: list[PoseRegions] = field(default_factory=list)

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        if estimate.region is not None:
            self.frames.append(frame.index)
            self.regions.append(estimate.region)


@report_errors()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for all files of the demo.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the world, flight, split and training.")] = 0,
    method: Annotated[
        Method, typer.Option(help="conformodal, or paper: the paper's system in the same world.")
    ] = Method.CONFORMODAL,
) -> None:
    """Fly through a corridor of identical rooms, learn it, and localize the camera by conformal regions and motion."""
    started, config, features = time.perf_counter(), _config(method, seed), FeatureCache(out / "cache")
    with lock_output(out, "demo"), progress_bars(out) as report:
        sequence = _corridor(out / "corridor", seed, report)
        model = train_on(sequence, config, out / "model", features=features, report=report)
        answered = _AnsweredFrames()
        stream = RecordingStream(sequence, part_frames(model, sequence, Part.TEST))
        answers = answer_stream(model, stream, out, report, part=Part.TEST, sinks=[answered])
        regions, truth = PoseRegions.concatenate(answered.regions), sequence.require_truth()[np.array(answered.frames)]
        # a regressor with the same features, epochs and settings
        classical = train_plain(prepare_training_data(sequence, config, features, report), config.training)
        looked_at = extract_features([sequence.image_paths[i] for i in answered.frames], model.backbone, features)
        answers.trajectories["classical"] = classical.trajectory(looked_at, truth.timestamps_s)
        write_tum(out / "methods" / "classical.tum", answers.trajectories["classical"])
        world = CorridorWorld(N_MODULES, seed=seed)
        check = check_ambiguity(regions, truth, model.sign_reference, Renderer(world), stage_of(report, "look-alikes"))
        metrics = {**metrics_of(answers), "command": "demo", "ambiguity": check.record()}
        metrics["seconds"] = round(time.perf_counter() - started, 2)
        place_line = _describe_places(metrics["ambiguity"])
        summary = [
            f"A drone flew along a dark hallway of {counted(N_MODULES, 'identical module')}, into every room. "
            f"{counted(len(model.split.train), 'frame')} trained a network, {len(model.split.calibration)} calibrated "
            f"its regions, {len(truth)} were held out ({metrics['split_note']})",
            place_line,
        ]
        title = "conformodal: a corridor of identical rooms"
        title += ", by the paper's system" if method is Method.PAPER else ""
        figure = _plan(answers, regions, truth, world, check)
        write_answers(answers, metrics, title, [*summary, *describe_outcome("demo", metrics)], [figure], world.plan())
    report_outcome("demo", metrics, unbounded=answers.unbounded)
    report_line(place_line)
    rmse_m = {name: row["rmse_m"] for name, row in metrics["errors"].items()}
    regressor = rmse_m.pop("classical")
    ratios = ", ".join(f"{name} {regressor / error:.2f}" for name, error in rmse_m.items())
    report_line(f"rmse_m of the classical regressor / of the method: {ratios} ({metrics['seconds']:.0f} s in all)")
    report_line(f"open {(out / PAGE).resolve()}")
    print_where(out)


def _config(method: Method, seed: int) -> ModelConfig:
    """The configuration of a method; both train in the same way."""
    training = replace(TRAINING, seed=seed)
    if method is Method.PAPER:
        return ModelConfig.paper(alpha=_PAPERS_ALPHA, seed=seed, training=training)
    return ModelConfig(alpha=ALPHA, seed=seed, training=training)


def _corridor(folder: Path, seed: int, report: StageProgress) -> Recording:
    """The flight of a seed; one that an earlier demo wrote is not written again."""
    mark, flight = folder / "demo.json", folder / "seq-01"
    wanted: dict[str, int] = {"seed": seed, "n_modules": N_MODULES, "n_laps": N_LAPS}
    if folder.exists() and not mark.is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise FolderError(f"{folder}: was not written by demo, which would overwrite it; take another folder")
    written: Any = None
    with suppress(OSError, ValueError):
        written = json.loads(mark.read_text(encoding="utf-8"))
    if written != wanted:  # marked as unfinished until the flight of this seed is there
        write_whole(mark, "{}\n")
        shutil.rmtree(flight, ignore_errors=True)
    if not flight.is_dir():
        write_corridor(folder, n_modules=N_MODULES, n_laps=N_LAPS, seed=seed, progress=stage_of(report, "corridor"))
    write_whole(mark, json.dumps(wanted) + "\n")
    return read_recording(folder)


def _describe_places(ambiguity: dict[str, Any]) -> str:
    """How many places look the same, and how many of them the regions hold."""
    n_frames, n_places = counted(ambiguity["n_frames"], "frame"), counted(ambiguity["n_places"], "other place")
    held = 100 * ambiguity["share_held"]
    return f"{n_frames} with {n_places} of the same view; the regions hold {held:.1f} % of these."


def _plan(
    answers: Answers, regions: PoseRegions, truth: Trajectory, world: CorridorWorld, check: AmbiguityCheck
) -> PageFigure:
    """The plan of a frame that has most look-alike places, all of them held."""
    index = int(np.argmax([len(p) if held.all() else -1 for p, held in zip(check.places, check.held, strict=True)]))
    n, name = len(check.places[index]), answers.writer.records[index]["frame"]
    paper = answers.model.method is Method.PAPER
    svg = plan_figure(
        regions,
        next(iter(answers.trajectories.values())),
        index,
        truth,
        classical=answers.trajectories["classical"],
        walls=world.plan(),
        alike=check.places[index],
        label="the paper's greedy answer" if paper else "conformal, after reasoning",
    )
    caption = (
        f"{name}, from above. {counted(n, 'other place')} {noun_for(n, 'has', 'have')} the same view: the region holds "
        f"{int(check.held[index].sum())}."
    )
    return PageFigure("plan", "One frame, and every place with the same view", caption, svg)
