"""``conformodal reproduce``: the paper's results on any data set."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.datasets import Layout, Sequence, SplitKind
from conformodal.experiments import run_tasks
from conformodal.experiments.table1 import (
    NETWORKS,
    Row,
    Table1Worker,
    TrainingTask,
    bin_runs,
    main_table,
    method_table,
    rows_of,
    tasks_of,
    tidy,
)
from conformodal.odometry import data_digest, provenance, write_metrics
from conformodal.vision import FeatureCache, TrainingConfig, default_cache_dir

from .console import console, kind_errors, print_where, progress_bars
from .figures import draw_figures
from .sources import open_sequence

app = typer.Typer(help="The paper's results on a data set of your own.", no_args_is_help=True)


_EPOCHS = TrainingConfig().epochs
_NETWORKS = ",".join(NETWORKS)


@app.callback()
def reproduce() -> None:
    """The paper's results on a data set of your own."""


Data = Annotated[Path, typer.Argument(help="Data set: images with poses.")]
Out = Annotated[Path, typer.Option(help="Folder for results; a run that was stopped goes on from there.")]
Format = Annotated[Layout, typer.Option("--format", help="Layout of the data set.")]
Epochs = Annotated[int, typer.Option(min=1, help="Of every training.")]
Networks = Annotated[str, typer.Option(help="A small, a middle and a large network, with commas between.")]
Cache = Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")]


@app.command()
@kind_errors
def table1(
    data: Data,
    out: Out,
    layout: Format = Layout.AUTO,
    seeds: Annotated[int, typer.Option(min=1, help="Repeats, each with a split and starts of its own.")] = 5,
    split: Annotated[SplitKind | None, typer.Option(help="One split only; both by default.")] = None,
    networks: Networks = _NETWORKS,
    epochs: Epochs = _EPOCHS,
    cache: Cache = None,
) -> None:
    """Less data, other networks, noise: the conformal method beside every baseline. Writes OUT/table1.md."""
    sequence = open_sequence(data, layout, require_poses=True)
    splits = list(SplitKind) if split is None else [split]
    rows = rows_of(networks.split(","))
    tasks, results = _work(sequence, out, rows, splits, seeds, epochs, cache)
    records = tidy(rows, tasks, results)
    (out / "table1.json").write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    text = [f"# The paper's table 1 on {sequence.name}", "", _note(seeds, epochs, networks)]
    for kind in splits:
        text += ["", f"## Split `{kind}`", "", main_table(rows, records, str(kind)), "", "Position RMSE in metres:", ""]
        text.append(method_table(rows, records, str(kind)))
    (out / "table1.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    settings: dict[str, Any] = {"data": sequence.name, "seeds": seeds, "epochs": epochs, "splits": splits}
    settings["networks"] = networks
    write_metrics(out, {"command": "reproduce table1", "provenance": provenance(), "configuration": settings})
    console.print("\n".join(text), soft_wrap=True, markup=False)
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
    cache: Cache = None,
) -> None:
    """The paper's figures from the runs of seed 0 under OUT, as SVG and PNG; what is not there yet is run first."""
    sequence = open_sequence(data, layout, require_poses=True)
    rows = rows_of(networks.split(","))
    _, results = _work(sequence, out, rows, [split], 1, epochs, cache)
    with progress_bars() as report:
        bins = bin_runs(sequence, out / "runs", split, epochs, FeatureCache(cache or default_cache_dir()), report)
    written = draw_figures(sequence, out, split, rows, bins, results)
    write_metrics(
        out / "figures",
        {
            "command": "reproduce figures",
            "provenance": provenance(),
            "configuration": {"data": sequence.name, "seed": 0, "split": split, "epochs": epochs, "networks": networks},
            "figures": written,
        },
    )
    console.print(f"{len(written)} figures: {', '.join(written)}", soft_wrap=True)
    print_where(out / "figures")


def _work(
    sequence: Sequence,
    out: Path,
    rows: tuple[Row, ...],
    splits: list[SplitKind],
    seeds: int,
    epochs: int,
    cache: Path | None,
) -> tuple[list[TrainingTask], list[dict[str, Any]]]:
    tasks = tasks_of(rows, splits, list(range(seeds)), epochs, data_digest(sequence))
    worker = Table1Worker(sequence, FeatureCache(cache or default_cache_dir()), out / "runs")
    with progress_bars() as report:
        return tasks, run_tasks(tasks, worker, out / "tasks", progress=report)


def _note(seeds: int, epochs: int, networks: str) -> str:
    over = f"{seeds} {'seed' if seeds == 1 else 'seeds'}"
    return (
        f"Mean ± standard deviation over {over} of split and training, {epochs} epochs. Ratio: the other's RMSE over "
        f"ours, seed by seed. Frozen features of {networks.replace(',', ', ')}; the test frames are the same fifth for "
        "every row, a fifth of the used frames calibrate, and the classical regressors are trained on these as well, "
        "at a learning rate searched for each. Noise is on the camera's pixels, in [0, 1], at test time only, for "
        "network and tracker alike. Whole pose covered: at alpha = 0.1 (bonferroni); promised for `interleaved` "
        "without noise, otherwise an observation. Set length and intervals: a target at alpha = 0.1, as in the paper, "
        "in standard deviations. Size against error: rank correlation of the position region's size and the smoothed "
        "answer's error."
    )
