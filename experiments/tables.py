"""From results of tasks to one record per row, split, seed and method, and to the tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from conformodal.core.words import counted
from conformodal.pipeline.config import Method

from .baselines import BASELINES
from .conditions import Row, TrainingTask

Record = dict[str, Any]
METHODS = {
    "paper": "the paper's system",
    "paper_softmax_mean": "the paper's system, softmax mean",
    "paper_plain": "plain regressor, paper's features",
    "paper_tuned": "tuned regressor, paper's features",
    "smoothed": "conformal, smoothed",
    "no_landmarks": "conformal, smoothed, without landmarks",
    "hindsight": "conformal, with hindsight",
    "greedy": "conformal, greedy over our intervals",
    "softmax_mean": "softmax mean",
    "plain": "plain regressor",
    "tuned": "tuned regressor",
    "tuned_smoothed": "tuned regressor, same smoother",
    "tuned_landmarks": "tuned regressor, our landmarks, search and smoother",
    "landmarks": "landmarks alone",
    **{name: kind.label for name, kind in BASELINES.items()},
}
# The answer of each system, in its run and in records, what tables call it, and the regressors on its features.
_SYSTEMS = {
    Method.PAPER: ("greedy", "paper", "the paper's system here", "its", ("paper_plain", "paper_tuned")),
    Method.CONFORMODAL: ("smoothed", "smoothed", "ours", "our", ("plain", "tuned")),
}
_BYTES = 4  # of a trained number
_REGIONS = {
    "coverage": "one target covered",
    "joint_coverage": "whole pose covered",
    "unbounded": "unbounded",
    "length": "set length",
    "intervals": "intervals",
    "size_error_rank_correlation": "size against error",
}


def tidy(rows: Sequence[Row], tasks: Sequence[TrainingTask], results: Sequence[Record]) -> list[Record]:
    """One record per row, split, seed and method.

    ``ratio`` is the error of the tuned regressor on the same features over the method's.
    """
    records = []
    for task, result in zip(tasks, results, strict=True):
        answer, name, *_ = _SYSTEMS[task.method]
        for row in rows:
            if (row.used, row.network) != (task.used, task.network):
                continue
            tested = result["noise"][f"{row.sigma:g}"]
            region = {f"region_{k}": v for k, v in tested["region"].items()}
            for method, errors in tested["errors"].items():
                papers = name if method == answer else f"paper_{method}"
                records.append(
                    {
                        "row": row.label,
                        "split": str(task.split),
                        "seed": task.seed,
                        "used": row.used,
                        "network": row.network,
                        "sigma": row.sigma,
                        "method": papers if task.method is Method.PAPER else method,
                        **errors,
                        "ratio": tested["errors"]["tuned"]["rmse_m"] / errors["rmse_m"],
                        **{f"frames_{k}": v for k, v in result["frames"].items()},
                        **result["cost"].get(method, {}),
                        **(region if method == answer else {}),
                    }
                )
    return records


@dataclass(frozen=True)
class Table:
    """Cells as they are shown; the first of each line says what the line is."""

    header: list[str]
    lines: list[list[str]]

    def markdown(self) -> str:
        """As Markdown."""
        rule = ["---"] * len(self.header)
        return "\n".join(f"| {' | '.join(cells)} |" for cells in (self.header, rule, *self.lines))


class Tables:
    """Tables of records.

    Parameters
    ----------
    rows, records
        Conditions, and what came out; see :func:`tidy`.
    """

    def __init__(self, rows: Sequence[Row], records: Sequence[Record]) -> None:
        self.rows, self.records = rows, records
        self.methods = {r["method"] for r in records}
        self.systems = [system for system in _SYSTEMS.values() if system[1] in self.methods]

    def leads(self, splits: Sequence[str]) -> dict[str, Table]:
        """By system, its errors beside those of regressors on its features; the paper's beside the published ones."""
        tables = {}
        for _, name, label, _, regressors in self.systems:
            beside, lines = name == "paper", []
            header = ["published, m", "published regressor, m", "published ratio"] if beside else []
            header = ["condition", "split", *header, f"{label}, m"]
            for kind in ("plain", "tuned"):
                header += [f"{kind} regressor, m", f"{kind} / {label}"]
            for split, row in product(splits, self.rows):
                cells = [row.label, split]
                if beside:
                    ratio = f"{row.paper_classical / row.paper_conformal:.1f}"
                    cells += [f"{row.paper_conformal:g}", f"{row.paper_classical:g}", ratio]
                cells.append(self._cell(row, split, name, "rmse_m", 4))
                for method in regressors:
                    ratios = self._ratios(row, split, method, name)
                    cells += [self._cell(row, split, method, "rmse_m", 4), spread(ratios, 2)]
                lines.append(cells)
            tables[label] = Table(header, lines)
        return tables

    def errors(self, split: str, key: str, digits: int) -> Table:
        """One error of every method that has records, in every row."""
        lines = [
            [name, *(self._cell(row, split, method, key, digits) for row in self.rows)]
            for method, name in METHODS.items()
            if method in self.methods
        ]
        return Table(["method", *(row.label for row in self.rows)], lines)

    def regions(self, split: str) -> Table:
        """Coverage and size of the regions of every system."""
        lines = []
        for row in self.rows:
            for _, method, label, *_ in self.systems:
                found = [self._cell(row, split, method, f"region_{key}", 2) for key in _REGIONS]
                lines.append([row.label, label, *found])
        return Table(["condition", "system", *_REGIONS.values()], lines)

    def costs(self, split: str) -> Table:
        """Training time and size of every method, in the second row."""
        row, lines = self.rows[1], []
        for method, name in METHODS.items():
            sizes = self._values(row, split, method, "n_parameters")
            if sizes:
                cells = [self._cell(row, split, method, "rmse_m", 4), self._cell(row, split, method, "train_s", 1)]
                lines.append([name, *cells, f"{np.mean(sizes) * _BYTES / 1e6:.1f}"])
        return Table(["method", "RMSE, m", "training, s", "trained or stored numbers, MB"], lines)

    def _values(self, row: Row, split: str, method: str, key: str) -> list[float]:
        wanted = (row.label, split, method)
        found = [r.get(key) for r in self.records if (r["row"], r["split"], r["method"]) == wanted]
        return [float(np.mean(v)) for v in found if v is not None]

    def _cell(self, row: Row, split: str, method: str, key: str, digits: int) -> str:
        return spread(self._values(row, split, method, key), digits)

    def _ratios(self, row: Row, split: str, method: str, over: str) -> list[float]:
        """Error of a method over that of another, seed by seed."""
        errors, others = (self._values(row, split, name, "rmse_m") for name in (method, over))
        return [a / b for a, b in zip(errors, others, strict=True)]


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds."""
    if not values:
        return ""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"


def page(
    title: str, rows: Sequence[Row], records: Sequence[Record], splits: Sequence[str], notes: Sequence[str]
) -> str:
    """All tables as Markdown: the comparison with the published numbers first, then all of every split."""
    tables = Tables(rows, records)
    text = [f"# {title}", *notes]
    for label, table in tables.leads(splits).items():
        text += [f"## Position RMSE: {label}", table.markdown()]
    for split in splits:
        named = {
            "Coverage and size of the regions": tables.regions(split),
            "Position RMSE, metres": tables.errors(split, "rmse_m", 4),
            "Orientation RMSE, degrees": tables.errors(split, "rmse_deg", 2),
            f"What they cost, at {rows[1].label}": tables.costs(split),
        }
        text.append(f"## Split {split}")
        for name, table in named.items():
            text += [f"{name}:", table.markdown()]
    return "\n\n".join(text) + "\n"


def notes_on(methods: Sequence[Method], seeds: Sequence[int], epochs: int, networks: str, workers: int) -> list[str]:
    """How to read the tables; the arguments are those of the command."""
    over = f"{counted(len(seeds), 'seed')} ({', '.join(map(str, seeds))})"
    notes = [
        f"Mean ± standard deviation over {over} of split and training, {counted(epochs, 'epoch')}. Frozen features of "
        f"{networks.replace(',', ', ')}. The test frames, a fifth unless recordings or lists decide, are the same for "
        "every row; a fifth of the used frames calibrates. Noise is on the camera's pixels, in [0, 1], at test time "
        "only, for network and tracker alike. Ratio: the regressor's RMSE over the system's, seed by seed; above 1 the "
        "system is better.",
        "Published: the paper's table 1 (RGB-D Scenes; EfficientNet b0, b3 and b7). The paper's system here: sections "
        "2 and 3 of the paper as they stand, with its greedy answer; features of the whole network, averaged over the "
        "image. The regressors see the same features as the system that they stand beside, and are trained on the "
        "calibration frames too. Plain: the same epochs, optimiser and settings. Tuned: learning rate, dropout and "
        "number of components (where there is one) are searched for each training, in batches of 32 where the system "
        "has 64. Regions are of single frames. Set length (in standard deviations) and intervals are those of one "
        "target at alpha = 0.1. Size against error: rank correlation of the position region's size and the error.",
        f"Costs: wall time with --workers {workers} on this machine, searches for settings included; a projection of "
        "the features that several methods share counts with the first of them.",
    ]
    if Method.CONFORMODAL in methods:
        notes.append(
            "Ours: the smoothed answer, which uses later frames too. Regions rest on softmax, neighbours and "
            "landmarks. Whole pose covered: at alpha = 0.1 (joint max), guaranteed for interleaved without noise, "
            "otherwise an observation; unbounded regions count as covered."
        )
    return notes
