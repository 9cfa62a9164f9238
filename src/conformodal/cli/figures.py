"""Which run goes into which of the paper's figures."""

from __future__ import annotations

from collections.abc import Sequence as Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from conformodal.datasets import Sequence, SplitKind
from conformodal.experiments.table1 import Row, run_name, task_key
from conformodal.motion import CornerTracker
from conformodal.report.paper import (
    band_figure,
    cuboid_figure,
    flow_figure,
    reliability_figure,
    save_figure,
    size_figure,
)
from conformodal.report.stored import StoredRun

_MOST_CUBOIDS = 30


def draw_figures(
    sequence: Sequence,
    out: Path,
    split: SplitKind,
    rows: Collection[Row],
    bins: dict[int, Path],
    results: Collection[dict[str, Any]],
) -> list[str]:
    """Write all figures under ``out/figures``; returns their names.

    Parameters
    ----------
    sequence
        For the images of figure 3.
    out
        Where ``reproduce`` keeps its runs.
    split, rows
        Whose runs.
    bins
        Folder of a run by the number of bins.
    results
        Of the tasks of seed 0, for reliability.
    """
    folder, written = out / "figures", []

    def save(name: str, figure: Any) -> None:
        save_figure(figure, folder, name)
        written.append(name)

    def stored(these: Collection[Row]) -> list[tuple[str, StoredRun]]:
        places = [out / "runs" / run_name(task_key(split, 0, r.used, r.network), r.sigma) for r in these]
        return [(row.label, StoredRun.read(place)) for row, place in zip(these, places, strict=True)]

    by_bins = [(f"K = {k}", StoredRun.read(path)) for k, path in bins.items()]
    save("figure2_cuboids", cuboid_figure(by_bins, _frame_to_show([run for _, run in by_bins])))
    save("figure3_flow", _flow(sequence))
    save("figure4_data", band_figure(stored(rows[:2])))
    save("figure5_networks", band_figure(stored(rows[2:5])))
    noise = stored(rows[5:])
    save("figure6_noise", band_figure(noise))
    save("size_and_error", size_figure(noise))
    region = results[1]["noise"]["0"]["region"]  # 80 % of the data
    curves = [
        (f"{split}, {what}", np.array(numbers["coverage_at"]))
        for what, numbers in (("softmax and landmarks", region), ("softmax alone", region["alone"]))
    ]
    save("reliability", reliability_figure(curves, region["n_calibration"], region["n_test"]))
    return written


def _frame_to_show(runs: Collection[StoredRun]) -> int:
    """The frame with the most cuboids that an eye can still tell apart; else the one with the fewest."""
    frames = range(len(runs[0].records))
    counts = np.array([[np.prod([max(len(run.intervals(i, t)), 1) for t in "xyz"]) for run in runs] for i in frames])
    most = counts.max(axis=1)
    return int(np.argmax(np.where(most <= _MOST_CUBOIDS, counts.sum(axis=1), -most)))


def _flow(sequence: Sequence) -> Any:
    """Corners through five frames from the middle of the recording."""
    start = max(0, len(sequence) // 2 - 5)
    tracker = CornerTracker()
    for i in range(start, min(start + 6, len(sequence))):
        image = sequence.image(i)
        tracker.advance(np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8))
        if i == start:
            tracker.mark()
    return flow_figure(image, *tracker.pairs())
