"""``conformodal demo``: make the corridor world, train in it, answer the test frames, write the page."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from conformodal.core.parallel import thread_limit
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted
from conformodal.corridor import write_passes
from conformodal.corridor.ambiguity import count_look_alikes
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory
from conformodal.io import Recording, SplitKind, read_recording
from conformodal.io.streams.frames import Frame, RecordingStream
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.folds import MAX_FOLDS
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.train import prepare_training_data
from conformodal.pipeline.workers import parallel_workers

from .answering import Part, answer_stream, describe_outcome, metrics_of, part_frames, report_outcome, write_answers
from .console import print_where, progress_bars, report_line
from .train import train_on

N_MODULES, N_PASSES, SPEED = 3, 4, 2.0
WRONG_M = 0.5  # a pose that is further off is wrong: rooms are 4 m apart


def demo(
    out: Annotated[Path, typer.Option(help="Folder for all files of the demo.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the world, flight, split and training.")] = 0,
) -> None:
    """Fly through a corridor of identical rooms, learn it, and localize the camera by conformal regions and motion."""
    started, features, training = time.perf_counter(), FeatureCache(out / "cache"), TrainingConfig(seed=seed)
    config = ModelConfig(split=SplitKind.RECORDINGS, test=1 / N_PASSES, seed=seed, training=training)
    # images are so small that threads mostly wait for each other's Python code
    workers = parallel_workers(min(thread_limit(), MAX_FOLDS))
    with lock_output(out, "demo"), progress_bars(out) as report, workers:
        sequence = _corridor(out / "corridor" / f"passes-seed-{seed}", seed, report)
        data = prepare_training_data(sequence, config, features, report)
        model = train_on(data, config, out / "model", report)
        answered: dict[int, PoseRegions] = {}

        def note(frame: Frame, estimate: Estimate, _: Trajectory | None) -> None:
            if estimate.region is not None:
                answered[frame.index] = estimate.region

        stream = RecordingStream(sequence, part_frames(model, sequence, Part.TEST))
        answers = answer_stream(model, stream, out, report, part=Part.TEST, sinks=[note])
        rows, regions = np.array(list(answered)), PoseRegions.concatenate(list(answered.values()))
        truth = sequence.require_truth()[rows]
        # a regressor with the same features, epochs and settings
        classical = train_plain(data, config.training)
        answers.trajectories["classical"] = classical.trajectory(data.features[rows], truth.timestamps_s)
        answers.writer.poses("classical", answers.trajectories["classical"])
        world = CorridorWorld(N_MODULES, seed=seed)
        renderer, progress = Renderer(world), stage_of(report, "look-alikes")
        places = count_look_alikes(regions, truth, model.sign_reference, renderer, progress)
        reliable = np.array([record["reliable"] for record in answers.writer.records()])
        off_m = np.linalg.norm(answers.trajectories[ONLINE].positions_xyz - truth.positions_xyz, axis=1)
        n_wrong = int((off_m[reliable] > WRONG_M).sum())
        metrics = {**metrics_of(answers), "command": "demo", "ambiguity": places, "n_reliable_wrong": n_wrong}
        metrics["seconds"] = round(time.perf_counter() - started, 2)
        poses = counted(len(rows), "pose")
        outcome = f"{reliable.sum()} of {poses} are reliable; {n_wrong} of these are over {WRONG_M} m off"
        alike = (
            f"{counted(places['n_frames'], 'frame')} with {counted(places['n_places'], 'other place')} of the same "
            f"view; the regions hold {100 * places['share_held']:.1f} % of these."
        )
        summary = [
            f"A drone flew {counted(N_PASSES, 'pass', 'passes')} through a dark hallway of "
            f"{counted(N_MODULES, 'identical module')}, from end to end and into every room. "
            f"{counted(N_PASSES - 1, 'pass', 'passes')}, "
            f"{len(model.split.train) + len(model.split.calibration)} frames, trained and calibrated the model; it "
            f"answered the other, {len(truth)} frames, as a stream. Stretches of the passes calibrate, so what is "
            "guaranteed is about a random frame of a new stretch of such a pass; the coverage of a new pass is an "
            "observation.",
            f"{outcome}.",
            alike,
            *describe_outcome("demo", metrics),
        ]
        write_answers(answers, metrics, "conformodal: a corridor of identical rooms", summary, world.plan())
    report_line(f"reliable: {outcome}")
    report_outcome("demo", metrics)
    report_line(alike)
    print_where(out)


def _corridor(folder: Path, seed: int, report: StageProgress) -> Recording:
    """The passes of a seed; those that are there are not flown again."""
    progress = stage_of(report, "corridor")
    return read_recording(
        write_passes(folder, n_modules=N_MODULES, n_passes=N_PASSES, seed=seed, speed=SPEED, progress=progress)
    )
