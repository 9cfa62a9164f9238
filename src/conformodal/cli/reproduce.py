"""``conformodal reproduce``: the paper's results on any data set."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.core.files import write_whole
from conformodal.datasets import Layout, Sequence, SplitKind
from conformodal.experiments import Engine, ExperimentError, LocalEngine, RayEngine, run_tasks
from conformodal.experiments.baselines import BASELINES
from conformodal.experiments.table1 import (
    NETWORKS,
    Row,
    Table1Worker,
    TrainingTask,
    bin_runs,
    rows_of,
    tasks_of,
    tidy,
    write_json,
    write_parquet,
)
from conformodal.odometry import Method, ResultsError, data_digest, provenance, read_metrics, write_metrics
from conformodal.odometry.results.folders import lock_output
from conformodal.report import table1_markdown, table1_notes, table1_sections, write_comparison
from conformodal.vision import FeatureCache, FineTuning, TrainingConfig

from .arguments import Cache, Data, DataLayout, cache_folder
from .console import kind_errors, print_where, progress_bars, say_line
from .figures import FigureWriter
from .sources import open_sequence
from .train import check_fine_tuning, tuning_of

app = typer.Typer(help="The paper's results on a data set of your own.", no_args_is_help=True)


_EPOCHS = TrainingConfig().epochs
_NETWORKS = ",".join(NETWORKS)


class Systems(StrEnum):
    """Which systems are reproduced."""

    ALL = "all"
    PAPER = "paper"

    @property
    def methods(self) -> list[Method]:
        """The paper's first: it takes minutes, where ours takes hours."""
        return [Method.PAPER] if self is Systems.PAPER else [Method.PAPER, Method.CONFORMODAL]


class EngineKind(StrEnum):
    """Where trainings run."""

    LOCAL = "local"
    RAY = "ray"


class WhichBaselines(StrEnum):
    """Which baselines stand beside ours, apart from the plain and the tuned regressor."""

    DEFAULT = "default"
    ALL = "all"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the baselines."""
        return tuple(name for name, kind in BASELINES.items() if kind.by_default or self is WhichBaselines.ALL)


@app.callback()
def reproduce() -> None:
    """The paper's results on a data set of your own."""


_Out = Annotated[Path, typer.Option(help="Folder for results; a run that was stopped goes on from there.")]
_SystemsOption = Annotated[
    Systems, typer.Option(help="all; or paper: the paper's system and the regressors on its features alone.")
]
_Baselines = Annotated[
    WhichBaselines,
    typer.Option(
        help="Beside ours. default: those that take seconds to train; all: also networks, each with a search."
    ),
]
_Epochs = Annotated[int, typer.Option(help="Of every training.")]
_Networks = Annotated[str, typer.Option(help="A small, a middle and a large network, with commas between.")]
_FineTune = Annotated[str, typer.Option(help="Also train the networks: last blocks (a number), 'all', or 'none'.")]
_EngineOption = Annotated[EngineKind, typer.Option("--engine", help="This machine, or a Ray cluster (extra 'ray').")]
_Workers = Annotated[
    int | None,
    typer.Option(
        help="Trainings at a time on this machine; they share its cores. 1 by default, 2 with --method paper.",
    ),
]
_Address = Annotated[str | None, typer.Option(help="Of the Ray cluster; one on this machine alone by default.")]


@app.command()
@kind_errors
def table1(
    data: Data,
    out: _Out,
    layout: DataLayout = Layout.AUTO,
    method: _SystemsOption = Systems.ALL,
    seeds: Annotated[int, typer.Option(help="Repeats, each with a split and starts of its own.")] = 5,
    first_seed: Annotated[
        int, typer.Option("--first-seed", help="Seed of the first repeat; only runs of seed 0 are kept to draw.")
    ] = 0,
    split: Annotated[SplitKind | None, typer.Option(help="One split only; by default interleaved and blocks.")] = None,
    networks: _Networks = _NETWORKS,
    epochs: _Epochs = _EPOCHS,
    baselines: _Baselines = WhichBaselines.DEFAULT,
    fine_tune: _FineTune = "none",
    cache: Cache = None,
    engine: _EngineOption = EngineKind.LOCAL,
    workers: _Workers = None,
    address: _Address = None,
) -> None:
    """Less data, other networks, noise: the paper's system, ours and baselines. Writes OUT/table1.md and .html."""
    workers = workers or _workers(method)
    where = _engine(engine, workers, address)
    rows = _rows(networks, fine_tune)
    with _opened(data, layout, out, cache) as (sequence, features):
        splits = [SplitKind.INTERLEAVED, SplitKind.BLOCKS] if split is None else [split]
        repeats = list(range(first_seed, first_seed + seeds))
        settings: dict[str, Any] = {"data": sequence.name, "seeds": seeds, "epochs": epochs, "splits": splits}
        settings |= {"method": method, "networks": networks, "fine_tune": fine_tune}
        settings |= {"first_seed": first_seed, "baselines": baselines, "engine": engine, "workers": workers}
        # a run that only goes on does not hide what those before it took, if they came to their end
        earlier = _earlier(out)
        before = earlier.get("seconds", 0.0) if earlier.get("configuration") == settings else 0.0
        started = time.perf_counter()
        plan = _Plan(rows, method, splits, repeats, epochs, fine_tune, baselines)
        tasks, results = plan.carry_out(sequence, out, features, where)
        records = tidy(rows, tasks, results)
        write_json(records, out / "table1.json")
        if find_spec("pyarrow"):  # an extra
            write_parquet(records, out / "table1.parquet")
        title = f"The paper's table 1 on {sequence.name}"
        notes = table1_notes(method.methods, repeats, epochs, networks, workers, fine_tune)
        sections = table1_sections(rows, tasks, results, records, [str(kind) for kind in splits])
        text = table1_markdown(title, notes, sections)
        write_whole(out / "table1.md", text)
        record: dict[str, Any] = {"command": "reproduce table1", "provenance": provenance(), "configuration": settings}
        record["seconds"] = round(before + time.perf_counter() - started, 3)
        write_metrics(out, record)
        write_comparison(out / "table1.html", title, notes, sections, record)
    for line in text.splitlines():
        say_line(line)
    print_where(out)


@app.command("figures")
@kind_errors
def draw(
    data: Data,
    out: _Out,
    layout: DataLayout = Layout.AUTO,
    method: _SystemsOption = Systems.ALL,
    split: Annotated[SplitKind, typer.Option(help="Which split's runs to draw.")] = SplitKind.INTERLEAVED,
    networks: _Networks = _NETWORKS,
    epochs: _Epochs = _EPOCHS,
    baselines: _Baselines = WhichBaselines.DEFAULT,
    fine_tune: _FineTune = "none",
    cache: Cache = None,
    engine: _EngineOption = EngineKind.LOCAL,
    workers: _Workers = None,
    address: _Address = None,
) -> None:
    """The paper's figures from the runs of seed 0 under OUT, as SVG and PNG; what is not there yet is run first."""
    where = _engine(engine, workers or _workers(method), address)
    rows = _rows(networks, fine_tune)
    with _opened(data, layout, out, cache) as (sequence, features):
        plan = _Plan(rows, method, [split], [0], epochs, fine_tune, baselines)
        tasks, results = plan.carry_out(sequence, out, features, where)
        figures = FigureWriter(sequence, out, split, rows)
        figures.flow()
        for system in method.methods:
            with progress_bars() as report:
                bins = bin_runs(sequence, out / "runs", split, epochs, features, report, method=system)
            figures.regions(system, bins)
            if system is Method.PAPER:
                figures.steps(bins, features)
        if method is Systems.ALL:
            figures.sizes(_region_at(rows[1], tasks, results))
        settings = {"data": sequence.name, "method": method, "seed": 0, "split": split, "epochs": epochs}
        record: dict[str, Any] = {"command": "reproduce figures", "provenance": provenance()}
        record |= {"configuration": settings | {"networks": networks}, "figures": figures.written}
        write_metrics(out / "figures", record)
    say_line(f"{len(figures.written)} figures: {', '.join(figures.written)}")
    print_where(out / "figures")


def _rows(networks: str, fine_tune: str) -> tuple[Row, ...]:
    """Rows with networks that are there, and that have as many blocks as are to be trained."""
    names = networks.split(",")
    for name in names:
        check_fine_tuning(name, tuning_of(fine_tune, FineTuning().epochs, 0))
    return rows_of(names)


def _earlier(out: Path) -> dict[str, Any]:
    """What an earlier run said, if it came to its end and can be read."""
    with suppress(ResultsError):
        return read_metrics(out)
    return {}


@contextmanager
def _opened(data: Path, layout: Layout, out: Path, cache: Path | None) -> Iterator[tuple[Sequence, FeatureCache]]:
    """The data set and the cache of features, with the folder of results to oneself."""
    with lock_output(out, "reproduce", apart=[data]):
        features = FeatureCache(cache_folder(cache))
        yield open_sequence(data, layout, require_poses=True), features


@dataclass(frozen=True)
class _Plan:
    """What is trained and answered: all rows, by all systems, on all splits and seeds."""

    rows: tuple[Row, ...]
    systems: Systems
    splits: list[SplitKind]
    seeds: list[int]
    epochs: int
    fine_tune: str
    baselines: WhichBaselines

    def carry_out(
        self, sequence: Sequence, out: Path, features: FeatureCache, engine: Engine
    ) -> tuple[list[TrainingTask], list[dict[str, Any]]]:
        """The tasks, and the result of each; those that have one already are not run again."""
        tuning = tuning_of(self.fine_tune, FineTuning().epochs, 0)
        digest = data_digest(sequence)
        systems, others = self.systems.methods, self.baselines.names
        tasks = tasks_of(self.rows, self.splits, self.seeds, self.epochs, digest, tuning, systems, others)
        worker = Table1Worker(sequence, features, out / "runs")
        with progress_bars() as report:
            return tasks, run_tasks(tasks, worker, out / "tasks", report, engine)


def _region_at(row: Row, tasks: list[TrainingTask], results: list[dict[str, Any]]) -> dict[str, Any]:
    """Numbers about the regions of our system in a row."""
    for task, result in zip(tasks, results, strict=True):
        if (task.method, task.used, task.network) == (Method.CONFORMODAL, row.used, row.network):
            return dict(result["noise"][f"{row.sigma:g}"]["region"])
    raise ExperimentError(f"no task of ours is for the row {row.label}")


def _engine(kind: EngineKind, workers: int, address: str | None) -> Engine:
    return RayEngine(address) if kind is EngineKind.RAY else LocalEngine(workers)


def _workers(systems: Systems) -> int:
    """Small networks train far faster on one core each than on all cores together; ours may want the memory."""
    return min(2, os.cpu_count() or 1) if systems is Systems.PAPER else 1
