"""Which run goes into which of the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Collection
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from conformodal.datasets import Sequence, SplitKind
from conformodal.experiments.table1 import Row, Softmaxes, run_name, task_key
from conformodal.odometry import Method
from conformodal.report.overview import binning_figure, overview_figure, softmax_figure
from conformodal.report.paper import (
    band_figure,
    cuboid_figure,
    flow_figure,
    reliability_figure,
    save_figure,
    size_figure,
)
from conformodal.report.stored import StoredRun
from conformodal.vision import FeatureCache

from .steps import MOST_CUBOIDS, flow_to, steps_of, training_values

_ENDINGS = {Method.PAPER: "paper", Method.CONFORMODAL: "ours"}
_ANSWERS = {Method.PAPER: "the paper's greedy answer", Method.CONFORMODAL: "our answer, after reasoning"}


class FigureWriter:
    """Writes figures under ``OUT/figures`` and remembers their names.

    Parameters
    ----------
    sequence
        For images.
    out
        Where ``reproduce`` keeps its runs.
    split, rows
        Whose runs.
    """

    def __init__(self, sequence: Sequence, out: Path, split: SplitKind, rows: Collection[Row]) -> None:
        self.sequence = sequence
        self.out = out
        self.split = split
        self.rows = rows
        self.written: list[str] = []

    def flow(self) -> None:
        """Figure 3, from the middle of the recording; both systems follow the same corners."""
        self._save("figure3", flow_figure(*flow_to(self.sequence, len(self.sequence) // 2)))

    def steps(self, bins: Mapping[int, Path], cache: FeatureCache) -> None:
        """Figures 1, 2a and 2b, from the paper's system: bins are the fewest, softmaxes have the most.

        Parameters
        ----------
        bins
            Folders of runs, with their models, by the number of bins.
        cache
            Of features.
        """
        said = []
        for k in (min(bins), max(bins)):
            run = StoredRun.read(bins[k])
            names = [record["frame"] for record in run.records]
            said.append(Softmaxes.of(bins[k], names, self.sequence, cache))
        coarse, fine = said
        steps = steps_of(fine, run, self.sequence)
        softmax = steps.softmaxes[steps.shown]
        self._save("figure1_paper", overview_figure(steps))
        times, values = training_values(coarse, self.sequence, steps.shown)
        edges = coarse.model.bins.edges_[steps.shown]
        self._save("figure2a_paper", binning_figure(times, values, edges, softmax.target))
        self._save("figure2b_paper", softmax_figure(softmax))

    def regions(self, method: Method, bins: Mapping[int, Path]) -> None:
        """Figures 2c and 2d, and 4 to 6, from the runs of one system."""
        ending, answer = _ENDINGS[method], _ANSWERS[method]
        by_bins = [(f"K = {k}", StoredRun.read(path)) for k, path in bins.items()]
        self._save(f"figure2cd_{ending}", cuboid_figure(by_bins, _frame_to_show([run for _, run in by_bins])))
        for number, rows in ((4, self.rows[:2]), (5, self.rows[2:5]), (6, self.rows[5:])):
            self._save(f"figure{number}_{ending}", band_figure(self._stored(method, rows), answer))

    def sizes(self, region: Mapping[str, Any]) -> None:
        """Of ours: size against error over all noises, and reliability.

        Parameters
        ----------
        region
            Numbers about the regions of a task of seed 0.
        """
        self._save("size_and_error", size_figure(self._stored(Method.CONFORMODAL, self.rows[5:])))
        curves = [
            (f"{self.split}, {what}", np.array(numbers["coverage_at"]))
            for what, numbers in (("softmax and landmarks", region), ("softmax alone", region["alone"]))
        ]
        self._save("reliability", reliability_figure(curves, region["n_calibration"], region["n_test"]))

    def _stored(self, method: Method, rows: Collection[Row]) -> list[tuple[str, StoredRun]]:
        names = [run_name(task_key(method, self.split, 0, r.used, r.network), r.sigma) for r in rows]
        return [(row.label, StoredRun.read(self.out / "runs" / name)) for row, name in zip(rows, names, strict=True)]

    def _save(self, name: str, figure: Figure) -> None:
        save_figure(figure, self.out / "figures", name)
        self.written.append(name)


def _frame_to_show(runs: Collection[StoredRun]) -> int:
    """The frame with the most cuboids that an eye can still tell apart; else the one with the fewest."""
    frames = range(len(runs[0].records))
    counts = np.array([[np.prod([max(len(run.intervals(i, t)), 1) for t in "xyz"]) for run in runs] for i in frames])
    most = counts.max(axis=1)
    return int(np.argmax(np.where(most <= MOST_CUBOIDS, counts.sum(axis=1), -most)))
