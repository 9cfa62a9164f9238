"""``conformodal reproduce``: the paper's results on any data set."""

from __future__ import annotations

import time
from contextlib import suppress
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal._files import check_writable, write_whole
from conformodal.datasets import Layout, Sequence, SplitKind
from conformodal.experiments import Engine, LocalEngine, RayEngine, run_tasks
from conformodal.experiments.table1 import (
    METHODS,
    NETWORKS,
    Record,
    Row,
    Table,
    Table1Worker,
    TrainingTask,
    bin_runs,
    cost_table,
    main_table,
    method_table,
    region_table,
    rows_of,
    size_table,
    tasks_of,
    tidy,
    write_json,
    write_parquet,
)
from conformodal.odometry import ResultsError, data_digest, provenance, read_metrics, write_metrics
from conformodal.odometry.folders import check_no_stray, claimed
from conformodal.report import Section, error_chart, write_comparison
from conformodal.vision import FeatureCache, FineTuning, TrainingConfig, default_cache_dir

from .console import console, kind_errors, print_where, progress_bars
from .figures import draw_figures
from .sources import open_sequence
from .train import check_fine_tuning, tuning_of

app = typer.Typer(help="The paper's results on a data set of your own.", no_args_is_help=True)


_EPOCHS = TrainingConfig().epochs
_NETWORKS = ",".join(NETWORKS)


class EngineKind(StrEnum):
    """Where trainings run."""

    LOCAL = "local"
    RAY = "ray"


@app.callback()
def reproduce() -> None:
    """The paper's results on a data set of your own."""


Data = Annotated[Path, typer.Argument(help="Data set: images with poses.")]
Out = Annotated[Path, typer.Option(help="Folder for results; a run that was stopped goes on from there.")]
Format = Annotated[Layout, typer.Option("--format", help="Layout of the data set.")]
Epochs = Annotated[int, typer.Option(min=1, help="Of every training.")]
Networks = Annotated[str, typer.Option(help="A small, a middle and a large network, with commas between.")]
Cache = Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")]
FineTune = Annotated[str, typer.Option(help="Also train the networks: last blocks (a number), 'all', or 'none'.")]
EngineOption = Annotated[EngineKind, typer.Option("--engine", help="This machine, or a Ray cluster (extra 'ray').")]
Workers = Annotated[int, typer.Option(min=1, help="Trainings at a time on this machine; they share its cores.")]
Address = Annotated[str | None, typer.Option(help="Of the Ray cluster; one on this machine alone by default.")]


@app.command()
@kind_errors
def table1(
    data: Data,
    out: Out,
    layout: Format = Layout.AUTO,
    seeds: Annotated[int, typer.Option(min=1, help="Repeats, each with a split and starts of its own.")] = 5,
    split: Annotated[SplitKind | None, typer.Option(help="One split only; by default interleaved and blocks.")] = None,
    networks: Networks = _NETWORKS,
    epochs: Epochs = _EPOCHS,
    fine_tune: FineTune = "none",
    cache: Cache = None,
    engine: EngineOption = EngineKind.LOCAL,
    workers: Workers = 1,
    address: Address = None,
) -> None:
    """Less data, other networks, noise: the conformal method beside every baseline. Writes OUT/table1.md and .html."""
    where, cache_dir = _engine(engine, workers, address), cache or default_cache_dir()
    rows = _rows(networks, fine_tune)
    with claimed(out, "reproduce", apart=[data]):
        check_no_stray(out, "reproduce")
        check_writable(cache_dir)
        sequence = open_sequence(data, layout, require_poses=True)
        splits = [SplitKind.INTERLEAVED, SplitKind.BLOCKS] if split is None else [split]
        settings: dict[str, Any] = {"data": sequence.name, "seeds": seeds, "epochs": epochs, "splits": splits}
        settings |= {"networks": networks, "fine_tune": fine_tune, "engine": engine, "workers": workers}
        # a run that only goes on does not hide what those before it took, if they came to their end
        earlier = _earlier(out)
        before = earlier.get("seconds", 0.0) if earlier.get("configuration") == settings else 0.0
        started = time.perf_counter()
        tasks, results = _work(sequence, out, rows, splits, seeds, epochs, fine_tune, cache_dir, where)
        records = tidy(rows, tasks, results)
        write_json(records, out / "table1.json")
        if find_spec("pyarrow"):  # an extra
            write_parquet(records, out / "table1.parquet")
        title, note = f"The paper's table 1 on {sequence.name}", _note(seeds, epochs, networks, workers, fine_tune)
        tables = {str(kind): _tables(rows, tasks, results, records, str(kind)) for kind in splits}
        text = [f"# {title}", "", note]
        for kind, found in tables.items():
            text += ["", f"## Split `{kind}`"]
            for name, table in found:
                text += ["", f"{name}:", "", table.markdown()]
        write_whole(out / "table1.md", "\n".join(text) + "\n")
        record: dict[str, Any] = {"command": "reproduce table1", "provenance": provenance(), "configuration": settings}
        record["seconds"] = round(before + time.perf_counter() - started, 3)
        write_metrics(out, record)
        sections = [
            Section(
                f"Split {kind}",
                _CAPTION,
                error_chart([r.label for r in rows], _errors(rows, records, kind), "m"),
                found,
            )
            for kind, found in tables.items()
        ]
        write_comparison(out / "table1.html", title, [note.replace("`", "")], sections, record)
    for line in "\n".join(text).splitlines():
        console.print(line, soft_wrap=True)
    print_where(out)


@app.command()
@kind_errors
def figures(
    data: Data,
    out: Out,
    layout: Format = Layout.AUTO,
    split: Annotated[SplitKind, typer.Option(help="Which split's runs to draw.")] = SplitKind.INTERLEAVED,
    networks: Networks = _NETWORKS,
    epochs: Epochs = _EPOCHS,
    fine_tune: FineTune = "none",
    cache: Cache = None,
    engine: EngineOption = EngineKind.LOCAL,
    workers: Workers = 1,
    address: Address = None,
) -> None:
    """The paper's figures from the runs of seed 0 under OUT, as SVG and PNG; what is not there yet is run first."""
    where, cache_dir = _engine(engine, workers, address), cache or default_cache_dir()
    rows = _rows(networks, fine_tune)
    with claimed(out, "reproduce", apart=[data]):
        check_no_stray(out, "reproduce")
        check_writable(cache_dir)
        sequence = open_sequence(data, layout, require_poses=True)
        _, results = _work(sequence, out, rows, [split], 1, epochs, fine_tune, cache_dir, where)
        with progress_bars() as report:
            bins = bin_runs(sequence, out / "runs", split, epochs, FeatureCache(cache_dir), report)
        written = draw_figures(sequence, out, split, rows, bins, results)
        write_metrics(
            out / "figures",
            {
                "command": "reproduce figures",
                "provenance": provenance(),
                "configuration": {
                    "data": sequence.name,
                    "seed": 0,
                    "split": split,
                    "epochs": epochs,
                    "networks": networks,
                },
                "figures": written,
            },
        )
    console.print(f"{len(written)} figures: {', '.join(written)}", soft_wrap=True)
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


def _work(
    sequence: Sequence,
    out: Path,
    rows: tuple[Row, ...],
    splits: list[SplitKind],
    seeds: int,
    epochs: int,
    fine_tune: str,
    cache: Path,
    engine: Engine,
) -> tuple[list[TrainingTask], list[dict[str, Any]]]:
    tuning = tuning_of(fine_tune, FineTuning().epochs, 0)
    tasks = tasks_of(rows, splits, list(range(seeds)), epochs, data_digest(sequence), tuning)
    worker = Table1Worker(sequence, FeatureCache(cache), out / "runs")
    with progress_bars() as report:
        return tasks, run_tasks(tasks, worker, out / "tasks", report, engine)


def _engine(kind: EngineKind, workers: int, address: str | None) -> Engine:
    return RayEngine(address) if kind is EngineKind.RAY else LocalEngine(workers)


def _tables(
    rows: tuple[Row, ...],
    tasks: list[TrainingTask],
    results: list[dict[str, Any]],
    records: list[Record],
    split: str,
) -> list[tuple[str, Table]]:
    return [
        ("Position and orientation RMSE beside the paper's", main_table(rows, records, split)),
        ("Regions from softmax and landmarks, and from the softmax alone", region_table(rows, records, split)),
        ("Position RMSE of every method, in metres", method_table(rows, records, split)),
        (f"What they cost, at {rows[1].label}", cost_table(rows[1], records, split)),
        (
            "Rank correlation of the region's size over several rows together",
            size_table(rows, tasks, results, split),
        ),
    ]


def _errors(rows: tuple[Row, ...], records: list[Record], split: str) -> dict[str, list[list[float]]]:
    """Position RMSE by method: for every row, of all seeds."""
    at = {(r["method"], r["row"], r["seed"]): r["rmse_m"] for r in records if r["split"] == split}
    seeds = sorted({seed for _, _, seed in at})
    return {name: [[at[m, row.label, s] for s in seeds] for row in rows] for m, name in METHODS.items()}


_CAPTION = "Marks are means over seeds, whiskers reach from the best to the worst seed. Less is better."


def _note(seeds: int, epochs: int, networks: str, workers: int, fine_tune: str) -> str:
    over = f"{seeds} {'seed' if seeds == 1 else 'seeds'}"
    features = "Frozen" if fine_tune == "none" else f"Fine-tuned (--fine-tune {fine_tune}, on the training part)"
    return (
        f"Mean ± standard deviation over {over} of split and training, {epochs} epochs. Ratio: the other's RMSE over "
        f"ours, seed by seed. {features} features of {networks.replace(',', ', ')}. The test frames, a fifth "
        "unless recordings or lists decide, are the same for every row; a fifth of the used frames calibrates. The "
        "classical regressors are trained on these as well, with learning rate, dropout and number of components "
        "searched for each, and the other networks with learning rate and dropout; theirs are batches of 32, ours of "
        "64. Noise is on the camera's pixels, in [0, 1], at test time only, for network and tracker alike. Regions are "
        "of single frames, "
        "from softmax and landmarks. Whole pose covered: at alpha = 0.1 (joint max); promised for `interleaved` "
        "without noise, otherwise an observation. Set length and intervals: a target at alpha = 0.1, as in the paper, "
        "in standard deviations. Size against error: rank correlation of the position region's size and the smoothed "
        "answer's error. "
        f"Costs: wall time with {workers} trainings at a time on this machine, searches for settings "
        "included; a projection of the features that several share counts with the first of them, mostly ours; "
        "the other networks but ours start from the classical regressor's, "
        "whose search is counted once, as its own; locally linear regression is the part of our search that is one, "
        "alone. An answer is all that follows the features (and, for ours, the motions)."
    )
