"""``conformodal demo``: make the corridor world, train in it, answer the test frames, write the page."""

from __future__ import annotations

import json
import shutil
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from conformodal.cli.demo_pages import answer_test_part, describe_places, describe_ratios, page_of
from conformodal.core.files import FolderError, write_whole
from conformodal.core.progress import StageProgress, stage_of
from conformodal.corridor.ambiguity import check_ambiguity
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.corridor.writer import write_corridor
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.io import Recording, read_recording
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.report.page import write_page

from .console import print_where, progress_bars, report_line
from .failures import report_errors
from .outcome import report_outcome
from .train import train_on

N_MODULES, N_LAPS = 5, 2
# Strong dropout: in a world made of copies, a network that remembers frames tells copies apart by chance details. All
# features, not their principal components: rooms differ in small things.
TRAINING = TrainingConfig(epochs=40, dropout=0.6, components=None)
ALPHA = 0.02
_PAPERS_ALPHA = 0.1  # the paper's example, of each target


@report_errors()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for all files of the demo.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the world, flight, split and training.")] = 0,
    method: Annotated[
        Method, typer.Option(help="conformodal, or paper: the paper's system in the same world.")
    ] = Method.CONFORMODAL,
) -> None:
    """Fly through a corridor of identical rooms, learn it, and localize the camera by conformal regions and motion."""
    started = time.perf_counter()
    config = _config(method, seed)
    with lock_output(out, "demo"), progress_bars(out) as report:
        sequence = _corridor(out / "corridor", seed, report)
        model = train_on(sequence, config, out / "model", features=FeatureCache(out / "cache"), report=report)
        outcome = answer_test_part(model, config, out, sequence, report)
        world = CorridorWorld(N_MODULES, seed=seed)
        alike = check_ambiguity(
            outcome.run.regions, outcome.truth, model.sign_reference, Renderer(world), stage_of(report, "look-alikes")
        )
        outcome.metrics["ambiguity"] = alike.record()
        outcome.metrics["command"] = "demo"
        outcome.metrics["seconds"] = round(time.perf_counter() - started, 2)
        write_metrics(out, outcome.metrics)
        write_page(out / "report.html", page_of(outcome, sequence, model, world, alike))
    report_outcome("demo", outcome.metrics, unbounded=outcome.metrics["coverage"]["unbounded"])
    report_line(describe_places(outcome.metrics["ambiguity"]))
    report_line(describe_ratios(outcome.metrics))
    report_line(f"open {(out / 'report.html').resolve()}")
    print_where(out)


def _config(method: Method, seed: int) -> ModelConfig:
    """The configuration of a method; both train in the same way."""
    training = replace(TRAINING, seed=seed)
    if method is Method.PAPER:
        return ModelConfig.paper(alpha=_PAPERS_ALPHA, seed=seed, training=training)
    return ModelConfig(alpha=ALPHA, seed=seed, training=training)


def _corridor(place: Path, seed: int, report: StageProgress) -> Recording:
    """The flight of a seed; one that an earlier demo wrote is not written again."""
    mark, flight, old = place / "demo.json", place / "seq-01", place / ".old"
    wanted, found = {"seed": seed, "n_modules": N_MODULES, "n_laps": N_LAPS}, None
    if place.exists() and not mark.is_file() and (not place.is_dir() or any(place.iterdir())):
        raise FolderError(f"{place}: was not written by demo, which would overwrite it; take another folder")
    with suppress(OSError, ValueError):
        found = json.loads(mark.read_text(encoding="utf-8"))
    shutil.rmtree(old, ignore_errors=True)
    if found != wanted and flight.exists():
        flight.rename(old)  # an interrupted deletion must not leave half a flight in this place
    write_whole(mark, json.dumps(wanted) + "\n")
    shutil.rmtree(old, ignore_errors=True)
    if not flight.is_dir():
        write_corridor(place, n_modules=N_MODULES, n_laps=N_LAPS, seed=seed, progress=stage_of(report, "corridor"))
    return read_recording(place)
