"""``conformodal demo``: make the corridor world, train in it, answer the test frames, write the page."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted
from conformodal.corridor import write_corridor
from conformodal.corridor.ambiguity import count_look_alikes
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory
from conformodal.io import Recording, SplitKind, read_recording
from conformodal.io.streams.frames import Frame, RecordingStream
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.train import prepare_training_data

from .answering import Part, answer_stream, describe_outcome, metrics_of, part_frames, report_outcome, write_answers
from .console import print_where, progress_bars, report_line
from .train import train_on

N_MODULES, N_LAPS = 5, 2
# Strong dropout: in a world made of copies, a network that remembers frames tells copies apart by chance details. All
# features, not their principal components: rooms differ in small things.
TRAINING = TrainingConfig(epochs=40, dropout=0.6, components=None)
ALPHA = 0.02


def demo(
    out: Annotated[Path, typer.Option(help="Folder for all files of the demo.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the world, flight, split and training.")] = 0,
) -> None:
    """Fly through a corridor of identical rooms, learn it, and localize the camera by conformal regions and motion."""
    started, features, training = time.perf_counter(), FeatureCache(out / "cache"), replace(TRAINING, seed=seed)
    config = ModelConfig(split=SplitKind.INTERLEAVED, alpha=ALPHA, seed=seed, training=training)
    with lock_output(out, "demo"), progress_bars(out) as report:
        sequence = _corridor(out / "corridor" / f"seed-{seed}", seed, report)
        model = train_on(sequence, config, out / "model", features=features, report=report)
        answered: dict[int, PoseRegions] = {}

        def note(frame: Frame, estimate: Estimate, _: Trajectory | None) -> None:
            if estimate.region is not None:
                answered[frame.index] = estimate.region

        stream = RecordingStream(sequence, part_frames(model, sequence, Part.TEST))
        answers = answer_stream(model, stream, out, report, part=Part.TEST, sinks=[note])
        regions = PoseRegions.concatenate(list(answered.values()))
        truth = sequence.require_truth()[np.array(list(answered))]
        # a regressor with the same features, epochs and settings
        classical = train_plain(prepare_training_data(sequence, config, features, report), config.training)
        looked_at = extract_features([sequence.image_paths[i] for i in answered], model.backbone, features)
        answers.trajectories["classical"] = classical.trajectory(looked_at, truth.timestamps_s)
        answers.writer.poses("classical", answers.trajectories["classical"])
        world = CorridorWorld(N_MODULES, seed=seed)
        renderer, progress = Renderer(world), stage_of(report, "look-alikes")
        places = count_look_alikes(regions, truth, model.sign_reference, renderer, progress)
        metrics = {**metrics_of(answers), "command": "demo", "ambiguity": places}
        metrics["seconds"] = round(time.perf_counter() - started, 2)
        alike = (
            f"{counted(places['n_frames'], 'frame')} with {counted(places['n_places'], 'other place')} of the same "
            f"view; the regions hold {100 * places['share_held']:.1f} % of these."
        )
        summary = [
            f"A drone flew along a dark hallway of {counted(N_MODULES, 'identical module')}, into every room. "
            f"{counted(len(model.split.train), 'frame')} trained a network, {len(model.split.calibration)} calibrated "
            f"its regions, {len(truth)} were held out: {metrics['split_note']}",
            alike,
            *describe_outcome("demo", metrics),
        ]
        write_answers(answers, metrics, "conformodal: a corridor of identical rooms", summary, world.plan())
    report_outcome("demo", metrics)
    report_line(alike)
    print_where(out)


def _corridor(folder: Path, seed: int, report: StageProgress) -> Recording:
    """The flight of a seed; one that is there is not written again."""
    if not (folder / "seq-01").is_dir():
        write_corridor(folder, n_modules=N_MODULES, n_laps=N_LAPS, seed=seed, progress=stage_of(report, "corridor"))
    return read_recording(folder)
