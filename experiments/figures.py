"""The paper's figures 1 to 6 from the runs of seed 0 under OUT, as SVG and PNG; what is not there yet is run first.

python -m experiments.figures DATA --out OUT [--method paper] [--workers N] [--engine ray]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Collection
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer
from matplotlib.figure import Figure

from conformodal.cli.console import print_where, progress_bars, report_errors, report_line
from conformodal.cli.sources import Cache, DataLayout
from conformodal.core.arrays import FloatArray
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import pose_targets
from conformodal.io import Layout, Recording, SplitKind
from conformodal.io.decoding import grey_image
from conformodal.localizer.evidence import FrameEvidence
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import ResultsError, read_metrics, write_metrics
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.pipeline.workers import Engine
from conformodal.tracking.tracker import CornerTracker

from .conditions import ALPHA, Row, run_name, task_key
from .drawing import (
    SoftmaxOfTarget,
    Steps,
    StoredRun,
    band_figure,
    binning_figure,
    cuboid_figure,
    flow_figure,
    overview_figure,
    save_figure,
    softmax_figure,
)
from .table1 import (
    ALL_NETWORKS,
    EPOCHS,
    Address,
    Data,
    Epochs,
    Networks,
    Others,
    Out,
    Plan,
    Systems,
    Where,
    Which,
    WhichBaselines,
    Workers,
    data_digest,
    opened,
)
from .tasks import ExperimentError
from .worker import write_run

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
_ENDINGS = {Method.PAPER: "paper", Method.CONFORMODAL: "ours"}
_ANSWERS = {Method.PAPER: "the paper's greedy answer", Method.CONFORMODAL: "our answer, after reasoning"}
_N_BINS = (10, 50)
_MAX_CUBOIDS = 30  # that an eye can tell apart
_FLOW_OVER = 5  # frames
_POSITION = "xyz"


@app.command()
@report_errors()
def figures(
    data: Data,
    out: Out,
    layout: DataLayout = Layout.AUTO,
    method: Which = Systems.ALL,
    split: Annotated[SplitKind, typer.Option(help="Which split's runs to draw.")] = SplitKind.INTERLEAVED,
    networks: Networks = ALL_NETWORKS,
    epochs: Epochs = EPOCHS,
    baselines: Others = WhichBaselines.DEFAULT,
    cache: Cache = None,
    engine: Where = Engine.LOCAL,
    workers: Workers = None,
    address: Address = None,
) -> None:
    """The paper's figures 1 to 6 from the runs of seed 0 under OUT, as SVG and PNG."""
    plan = Plan(method, [split], [0], networks, epochs, baselines, engine, workers, address)
    with opened(data, layout, out, cache) as (sequence, features):
        plan.carry_out(sequence, out, features)
        writer = FigureWriter(sequence, out, split, plan.rows)
        writer.save("figure3", flow_figure(*flow_to(sequence, len(sequence) // 2)))  # the same for both systems
        for system in method.methods:
            with progress_bars() as report:
                bins = bin_runs(sequence, out / "runs", split, epochs, features, report, method=system)
            writer.regions(system, bins)
            if system is Method.PAPER:
                writer.steps(bins, features)
        record: dict[str, Any] = {"command": "reproduce figures", "provenance": provenance()}
        record |= {"configuration": {"data": sequence.name, **plan.settings}, "figures": writer.written}
        write_metrics(out / "figures", record)
    report_line(f"{len(writer.written)} figures: {', '.join(writer.written)}")
    print_where(out / "figures")


def bin_runs(
    sequence: Recording,
    folder: Path,
    split: SplitKind,
    epochs: int,
    cache: FeatureCache,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    method: Method = Method.CONFORMODAL,
) -> dict[int, Path]:
    """Runs on the test part with few and with many bins, each target at alpha = 0.1, as in figures 2c and 2d.

    They are stored in `folder`, each with its model.
    """
    found = {}
    for k in _N_BINS:
        place = folder / f"{_ENDINGS[method]}-{split}-bins{k}"
        found[k] = place
        settings: dict[str, Any] = {"split": split, "n_bins": k, "alpha": ALPHA}
        settings["training"] = TrainingConfig(epochs=epochs)
        ours: dict[str, Any] = {"score": "lac", "joint": "none", "sources": ("head",)}
        config = ModelConfig.paper(**settings) if method is Method.PAPER else ModelConfig(**settings, **ours)
        wanted = {"method": str(method), "n_bins": k, "epochs": epochs, "data": data_digest(sequence)}
        with suppress(ResultsError):  # a run whose record is damaged is made again
            if read_metrics(place).get("configuration") == wanted:
                continue
        model = train_model(prepare_training_data(sequence, config, cache, progress), config, progress=progress)
        odometry, test = odometry_of(model), model.split.test
        run = odometry.process(sequence, test, progress=progress)
        names = [sequence.image_paths[i].name for i in run.frames]
        metrics = {"command": "run", "provenance": provenance(), "configuration": wanted}
        save_model(model, place / "model")
        write_run(place, run, names, sequence.require_truth()[run.frames], metrics)
    return found


class FigureWriter:
    """Writes figures under ``OUT/figures``, where the table keeps its runs, and remembers their names."""

    def __init__(self, sequence: Recording, out: Path, split: SplitKind, rows: Collection[Row]) -> None:
        self.sequence, self.out, self.split, self.rows = sequence, out, split, rows
        self.written: list[str] = []

    def steps(self, bins: Mapping[int, Path], cache: FeatureCache) -> None:
        """Figures 1, 2a and 2b, from the paper's system: bins are the fewest, softmaxes have the most.

        `bins` are folders of runs, with their models, by the number of bins.
        """
        steps = steps_of(bins[max(bins)], self.sequence, cache)
        softmax = steps.softmaxes[steps.shown]
        self.save("figure1_paper", overview_figure(steps))
        model = load_model(bins[min(bins)] / "model")
        times, edges = self.sequence.timestamps_s[model.split.train], model.bins.edges_[steps.shown]
        values = self.sequence.require_truth().positions_xyz[model.split.train, steps.shown]
        self.save("figure2a_paper", binning_figure(times - times[0], values, edges, softmax.target))
        self.save("figure2b_paper", softmax_figure(softmax))

    def regions(self, method: Method, bins: Mapping[int, Path]) -> None:
        """Figures 2c and 2d, and 4 to 6, from the runs of one system."""
        ending, answer = _ENDINGS[method], _ANSWERS[method]
        by_bins = [(f"K = {k}", StoredRun.read(path)) for k, path in bins.items()]
        self.save(f"figure2cd_{ending}", cuboid_figure(by_bins, _frame_to_show([run for _, run in by_bins])))
        for number, rows in ((4, self.rows[:2]), (5, self.rows[2:5]), (6, self.rows[5:])):
            names = [run_name(task_key(method, self.split, 0, r.used, r.network), r.sigma) for r in rows]
            stored = [(r.label, StoredRun.read(self.out / "runs" / n)) for r, n in zip(rows, names, strict=True)]
            self.save(f"figure{number}_{ending}", band_figure(stored, answer))

    def save(self, name: str, figure: Figure) -> None:
        """Write a figure."""
        save_figure(figure, self.out / "figures", name)
        self.written.append(name)


def _frame_to_show(runs: Collection[StoredRun]) -> int:
    """The frame with the most cuboids that an eye can still tell apart; else the one with the fewest."""
    frames = range(len(runs[0].records))
    counts = np.array([[np.prod([max(len(run.intervals(i, t)), 1) for t in "xyz"]) for run in runs] for i in frames])
    most = counts.max(axis=1)
    return int(np.argmax(np.where(most <= _MAX_CUBOIDS, counts.sum(axis=1), -most)))


def steps_of(place: Path, sequence: Recording, cache: FeatureCache) -> Steps:
    """One frame of a run of the paper's system, and the target that has most intervals there.

    Of the frames whose region contains the position it is the one with most intervals in a target; if no region does,
    or all are too many cuboids to see, the one with fewest cuboids.

    Raises
    ------
    ExperimentError
        If the sequence's test frames are not those of the run.
    """
    model, run = load_model(place / "model"), StoredRun.read(place)
    left, names = iter(model.split.test.tolist()), [record["frame"] for record in run.records]
    frames = np.array([next((i for i in left if sequence.image_paths[i].name == name), -1) for name in names])
    if -1 in frames:
        missing = names[frames.tolist().index(-1)]
        raise ExperimentError(f"{place}: its frame {missing} is not a test frame of {sequence.name}")
    features = extract_features([sequence.image_paths[i] for i in frames], model.backbone, cache)
    rule, proba = model.calibration, model.localizer.beliefs(FrameEvidence(features)).proba
    regions, least = rule.predict(proba), 1 - rule.thresholds_

    targets = pose_targets(run.truth, model.sign_reference)
    counts = regions.n_intervals[:, :3]
    cuboids = counts.prod(axis=1)
    earlier = np.maximum(frames - _FLOW_OVER, 0)
    moved = (earlier < frames) & (sequence.recording[earlier] == sequence.recording[frames])
    fits = regions.contains(targets)[:, :3].all(axis=1) & (cuboids <= _MAX_CUBOIDS) & moved
    frame = int(np.argmax(np.where(fits, counts.max(axis=1), -cuboids)))
    shown = int(np.argmax(counts[frame]))
    intervals, edges = regions.intervals(frame), model.bins.edges_
    softmaxes = [
        SoftmaxOfTarget(name, edges[j], proba[j][frame], float(least[j]), intervals[j], float(targets[frame, j]))
        for j, name in enumerate(_POSITION)
    ]
    image, before, now = flow_to(sequence, int(frames[frame]))
    positions = run.answer.positions_xyz, run.truth.positions_xyz
    return Steps(image, softmaxes, shown, (before, now), *positions, frame)


def flow_to(sequence: Recording, last: int) -> tuple[npt.NDArray[np.uint8], FloatArray, FloatArray]:
    """A frame's image, and corners (m, 2) followed into it: in the frame some frames earlier, and in this one.

    At the beginning of a recording they are followed through the frames that there are.
    """
    same = np.flatnonzero(sequence.recording[: last + 1] == sequence.recording[last])
    start = max(int(same[0]), last - _FLOW_OVER)
    tracker = CornerTracker()
    for i in range(start, last + 1):
        image = sequence.image(i)
        tracker.advance(grey_image(image))
        if i == start:
            tracker.mark()
    return image, *tracker.pairs()


if __name__ == "__main__":
    app()
