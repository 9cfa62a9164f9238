"""The paper's table 1 on any data set: less data, other networks, noise; the paper's system, ours and baselines.

python -m experiments.table1 DATA --out OUT [--method paper] [--workers N] [--engine ray]
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.cli.console import OptionError, print_where, progress_bars, report_errors, report_line
from conformodal.cli.sources import Cache, DataLayout, cache_folder, open_sequence
from conformodal.core.files import write_whole
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig, check_network
from conformodal.io import Layout, Recording, SplitKind
from conformodal.io.folders import writing_in
from conformodal.pipeline.config import Method
from conformodal.pipeline.identity import identify
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import write_metrics
from conformodal.pipeline.workers import Engine

from .baselines import BASELINES
from .conditions import NETWORKS, Row, TrainingTask, rows_of, tasks_of
from .tables import notes_on, page, tidy
from .tasks import run_tasks
from .worker import Table1Worker

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
EPOCHS, ALL_NETWORKS = TrainingConfig().epochs, ",".join(NETWORKS)


def data_digest(sequence: Recording) -> str:
    """Digest of everything in a data set that results depend on."""
    frames = identify(sequence)
    digest = hashlib.sha256(f"{sequence.camera} {sequence.noise}".encode())
    for array in (frames.files, frames.poses, sequence.timestamps_s, sequence.recording):
        digest.update(np.ascontiguousarray(array).tobytes())
    for path in sequence.image_paths:  # results name frames, and a frame's noise is drawn by its name
        digest.update(path.name.encode() + b"\0")
    return digest.hexdigest()


class Systems(StrEnum):
    """Which systems are trained."""

    ALL = "all"
    PAPER = "paper"

    @property
    def methods(self) -> list[Method]:
        """The paper's first: it takes minutes, where ours takes hours."""
        return [Method.PAPER] if self is Systems.PAPER else [Method.PAPER, Method.CONFORMODAL]


class WhichBaselines(StrEnum):
    """Which baselines stand beside ours, apart from the plain and the tuned regressor."""

    DEFAULT = "default"
    ALL = "all"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the baselines."""
        return tuple(name for name, kind in BASELINES.items() if kind.by_default or self is WhichBaselines.ALL)


Data = Annotated[Path, typer.Argument(help="Data set: images with poses.")]
Out = Annotated[Path, typer.Option(help="Folder for results; a run that was stopped goes on from there.")]
Which = Annotated[Systems, typer.Option(help="all; or paper: the paper's system and regressors on its features.")]
Others = Annotated[WhichBaselines, typer.Option(help="Beside ours. all: also networks, each with a search.")]
Epochs = Annotated[int, typer.Option(min=1, help="Of every training.")]
Networks = Annotated[str, typer.Option(help="A small, a middle and a large network, separated by commas.")]
Where = Annotated[Engine, typer.Option(help="This machine, or a Ray cluster (extra 'ray').")]
Workers = Annotated[int | None, typer.Option(min=1, help="Trainings at a time; 1, or with ray the cluster's CPUs.")]
Address = Annotated[str | None, typer.Option(help="Of the Ray cluster; by default one that Ray finds or starts.")]


@dataclass(frozen=True)
class Plan:
    """What is trained and answered: all rows, by all systems, on all splits and seeds; and where."""

    method: Systems
    splits: list[SplitKind]
    seeds: list[int]
    networks: str
    epochs: int
    baselines: WhichBaselines
    engine: Engine
    workers: int | None
    address: str | None

    def __post_init__(self) -> None:
        for name in self.networks.split(","):
            check_network(name)
        rows_of(self.networks.split(","))  # three of them
        if self.address is not None and self.engine is not Engine.RAY:
            raise OptionError(f"--address needs --engine ray, got --engine {self.engine}")

    @property
    def rows(self) -> tuple[Row, ...]:
        """The rows of the table, with their networks."""
        return rows_of(self.networks.split(","))

    def carry_out(
        self, sequence: Recording, out: Path, features: FeatureCache
    ) -> tuple[list[TrainingTask], list[dict[str, Any]]]:
        """The tasks and the result of each; those that have one already are not run again."""
        digest, names = data_digest(sequence), self.baselines.names
        tasks = tasks_of(self.rows, self.splits, self.seeds, self.epochs, digest, self.method.methods, names)
        worker = Table1Worker(sequence, features, out / "runs")
        where: dict[str, Any] = {"workers": self.workers, "engine": self.engine, "address": self.address}
        with progress_bars() as report:
            return tasks, run_tasks(tasks, worker, out / "tasks", report, **where)

    @property
    def settings(self) -> dict[str, Any]:
        """As they are recorded; where the work was done decides no number but times."""
        return {k: v for k, v in vars(self).items() if k != "address"}


@contextmanager
def opened(data: Path, layout: Layout, out: Path, cache: Path | None) -> Iterator[tuple[Recording, FeatureCache]]:
    """The data set and the cache of features, with the folder of results locked."""
    with writing_in(out):
        yield open_sequence(data, layout, require_poses=True), FeatureCache(cache_folder(cache))


@app.command()
@report_errors()
def table1(
    data: Data,
    out: Out,
    layout: DataLayout = Layout.AUTO,
    method: Which = Systems.ALL,
    seeds: Annotated[int, typer.Option(min=1, help="Repeats, each with a split and a start of its own.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="Of the first repeat; figures are drawn of seed 0.")] = 0,
    split: Annotated[SplitKind | None, typer.Option(help="One split; by default interleaved and blocks.")] = None,
    networks: Networks = ALL_NETWORKS,
    epochs: Epochs = EPOCHS,
    baselines: Others = WhichBaselines.DEFAULT,
    cache: Cache = None,
    engine: Where = Engine.LOCAL,
    workers: Workers = None,
    address: Address = None,
) -> None:
    """The paper's table 1 on a data set: less data, other networks, noise. Writes OUT/table1.md and .json."""
    splits = [SplitKind.INTERLEAVED, SplitKind.BLOCKS] if split is None else [split]
    repeats = list(range(first_seed, first_seed + seeds))
    plan = Plan(method, splits, repeats, networks, epochs, baselines, engine, workers, address)
    with opened(data, layout, out, cache) as (sequence, features):
        started = time.perf_counter()
        tasks, results = plan.carry_out(sequence, out, features)
        records = tidy(plan.rows, tasks, results)
        write_whole(out / "table1.json", json.dumps(records, indent=1) + "\n")
        notes = notes_on(method.methods, repeats, epochs, networks, workers or 1)
        title = f"The paper's table 1 on {sequence.name}"
        text = page(title, plan.rows, records, [str(kind) for kind in splits], notes)
        write_whole(out / "table1.md", text)
        record: dict[str, Any] = {"command": "reproduce table1", "provenance": provenance()}
        record["configuration"] = {"data": sequence.name, **plan.settings}
        record["seconds"] = round(time.perf_counter() - started, 3)
        write_metrics(out, record)
    for line in text.splitlines():
        report_line(line)
    print_where(out)


if __name__ == "__main__":
    app()
