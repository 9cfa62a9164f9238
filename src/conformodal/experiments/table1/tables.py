"""The tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..baselines import BASELINES
from .conditions import Row
from .summary import METHODS, Record

_BYTES = 4  # of a trained number
# The best of these stands beside the classical regressor.
_OTHERS = ("landmarks", *(name for name, kind in BASELINES.items() if not kind.is_classical))
# Systems that the first table compares: its answer, its labels, and the two regressors on its features.
_SYSTEMS = (
    ("paper", "the paper's system here", "the paper's system", "its", ("paper_plain", "paper_classical")),
    ("smoothed", "ours", "ours", "our", ("plain", "classical")),
)
_COST = (("rmse_m", 4), ("train_s", 1), ("answer_ms", 2))


@dataclass(frozen=True)
class Table:
    """Cells as they are shown; the first of each line says what the line is."""

    header: list[str]
    lines: list[list[str]]

    def markdown(self) -> str:
        """As Markdown."""
        rule = "| --- " * len(self.header) + "|"
        return "\n".join([_piped(self.header), rule, *map(_piped, self.lines)])


def _piped(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def lead_table(rows: Sequence[Row], records: Sequence[Record], splits: Sequence[str]) -> Table:
    """The paper's numbers, the paper's system here and ours, the latter two against regressors on their own features.

    A system without records has no columns.
    """
    there = {r["method"] for r in records}
    systems = [system for system in _SYSTEMS if system[0] in there]
    header = ["condition", "split", "published: conformal, m", "published: classical, m", "published: ratio"]
    for _, label, name, whose, _ in systems:
        header.append(f"{label}, m")
        for kind in ("plain", "tuned"):
            header += [f"{kind} regressor on {whose} features, m", f"{kind} / {name}"]
    lines = []
    for split in splits:
        for row in rows:
            published = row.paper_classical / row.paper_conformal
            cells = [row.label, split, f"{row.paper_conformal:g}", f"{row.paper_classical:g}", f"{published:.1f}"]
            for answer, _, _, _, regressors in systems:
                cells.append(_of(records, row, split, answer, "rmse_m", 4))
                for method in regressors:
                    cells.append(_of(records, row, split, method, "rmse_m", 4))
                    cells.append(spread(_ratios(records, row, split, method, answer), 2))
            lines.append(cells)
    return Table(header, lines)


def main_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> Table:
    """The paper's table, with its numbers beside ours."""
    header = [
        "condition",
        "conformal, m",
        "degrees",
        "classical, m",
        "degrees",
        "ratio",
        "same smoother: ratio",
        "best other: ratio",
        "whole pose covered",
        "set length",
        "intervals",
        "size against error",
        "paper: ratio (m / m)",
    ]
    lines = []
    for row in rows:
        cells = [row.label]
        for method in ("smoothed", "classical"):
            cells += [_of(records, row, split, method, "rmse_m", 4), _of(records, row, split, method, "rmse_deg", 2)]
        for method in ("classical", "classical_smoothed"):
            cells.append(spread(_ratios(records, row, split, method, "smoothed"), 2))
        others = {m: _ratios(records, row, split, m, "smoothed") for m in _OTHERS}
        best = min(others, key=lambda m: float(np.mean(others[m])))
        cells.append(f"{spread(others[best], 2)} {METHODS[best]}")
        cells.append(_of(records, row, split, "smoothed", "region_joint_coverage", 2))
        cells.append(spread([float(np.mean(v)) for v in _values(records, row, split, "smoothed", "region_length")], 2))
        cells.append(_of(records, row, split, "smoothed", "region_intervals", 2))
        cells.append(_of(records, row, split, "smoothed", "region_size_error_rank_correlation", 2))
        paper = row.paper_classical / row.paper_conformal
        cells.append(f"{paper:.1f} ({row.paper_classical:g} / {row.paper_conformal:g})")
        lines.append(cells)
    return Table(header, lines)


def method_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> Table:
    """Position RMSE in every row, of every method that has records."""
    there = {r["method"] for r in records}
    lines = [
        [name, *(_of(records, row, split, method, "rmse_m", 4) for row in rows)]
        for method, name in METHODS.items()
        if method in there
    ]
    return Table(["method", *(row.label for row in rows)], lines)


def region_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> Table:
    """What landmarks are worth to the regions, beside those from the image's softmax alone, of the same training."""
    names = {
        "joint_coverage": "whole pose covered",
        "coverage": "a target covered",
        "length": "set length",
        "intervals": "intervals",
        "size_error_rank_correlation": "size against error",
    }
    lines = []
    for row in rows:
        cells = [row.label]
        for key in names:
            for kind in ("region_", "region_alone_"):
                values = _values(records, row, split, "smoothed", kind + key)
                cells.append(spread([float(np.mean(v)) for v in values], 2))
        lines.append(cells)
    columns = [column for name in names.values() for column in (name, f"{name}, softmax alone")]
    return Table(["condition", *columns], lines)


def paper_region_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> Table:
    """Coverage and size of the regions of the paper's system."""
    keys = ("coverage", "joint_coverage", "length", "intervals")
    lines = []
    for row in rows:
        values = (_values(records, row, split, "paper", f"region_{key}") for key in keys)
        lines.append([row.label, *(spread([float(np.mean(v)) for v in of], 2) for of in values)])
    return Table(["condition", "a target covered", "whole pose covered", "set length", "intervals"], lines)


def cost_table(row: Row, records: Sequence[Record], split: str) -> Table:
    """What every method costs beside its error, in one row."""
    header = ["method", "RMSE, m", "training, s", "answer, ms a frame", "trained or stored numbers, MB"]
    lines = []
    for method, name in METHODS.items():
        if not _values(records, row, split, method, "train_s"):
            continue
        sizes = _values(records, row, split, method, "n_parameters")
        cells = [_of(records, row, split, method, key, digits) for key, digits in _COST]
        lines.append([name, *cells, f"{np.mean(sizes) * _BYTES / 1e6:.1f}"])
    return Table(header, lines)


def _values(records: Sequence[Record], row: Row, split: str, method: str, key: str) -> list[Any]:
    wanted = (row.label, split, method)
    found = [r.get(key) for r in records if (r["row"], r["split"], r["method"]) == wanted]
    return [v for v in found if v is not None]


def _of(records: Sequence[Record], row: Row, split: str, method: str, key: str, digits: int) -> str:
    return spread(_values(records, row, split, method, key), digits)


def _ratios(records: Sequence[Record], row: Row, split: str, method: str, over: str) -> list[float]:
    """Error of a method over that of another, seed by seed."""
    errors, others = (_values(records, row, split, name, "rmse_m") for name in (method, over))
    return [a / b for a, b in zip(errors, others, strict=True)]


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds."""
    if not values:
        return ""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"
