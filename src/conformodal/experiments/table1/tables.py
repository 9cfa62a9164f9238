"""The tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .conditions import Row
from .summary import METHODS, Record

_BYTES = 4  # of a trained number
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
        ratios = _ratios(records, row, split)
        cells += [spread(ratios["classical"], 2), spread(ratios["classical_smoothed"], 2)]
        others = {m: v for m, v in ratios.items() if m in METHODS and m not in _OURS and not m.startswith("classical")}
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
    """Every method's position RMSE in every row."""
    lines = [
        [name, *(_of(records, row, split, method, "rmse_m", 4) for row in rows)] for method, name in METHODS.items()
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


_OURS = ("smoothed", "no_landmarks", "viterbi", "greedy", "softmax_mean", "online")


def _values(records: Sequence[Record], row: Row, split: str, method: str, key: str) -> list[Any]:
    wanted = (row.label, split, method)
    found = [r.get(key) for r in records if (r["row"], r["split"], r["method"]) == wanted]
    return [v for v in found if v is not None]


def _of(records: Sequence[Record], row: Row, split: str, method: str, key: str, digits: int) -> str:
    return spread(_values(records, row, split, method, key), digits)


def _ratios(records: Sequence[Record], row: Row, split: str) -> dict[str, list[float]]:
    """Error of every other method over ours, seed by seed."""
    ours = _values(records, row, split, "smoothed", "rmse_m")
    methods = dict.fromkeys(r["method"] for r in records)
    return {
        m: [theirs / mine for theirs, mine in zip(_values(records, row, split, m, "rmse_m"), ours, strict=True)]
        for m in methods
    }


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds."""
    if not values:
        return ""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"
