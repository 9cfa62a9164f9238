"""From results of tasks to a tidy table, and to the table that is read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .conditions import Row, TrainingTask

METHODS = {
    "smoothed": "conformal, smoothed",
    "viterbi": "conformal, global search",
    "greedy": "conformal, the paper's greedy reasoning",
    "softmax_mean": "softmax mean",
    "classical": "classical",
    "classical_smoothed": "classical, same smoother",
    "learnt_weights": "classical, learnt loss weights",
    "mixture_density": "mixture density network",
    "dropout_passes": "MC dropout, 30 passes",
    "deep_ensemble": "deep ensemble of 5",
    "quantile_regression": "quantile regression (median)",
}
Record = dict[str, Any]


def tidy(rows: Sequence[Row], tasks: Sequence[TrainingTask], results: Sequence[Record]) -> list[Record]:
    """One record a row, split, seed and method."""
    records = []
    for task, result in zip(tasks, results, strict=True):
        for row in rows:
            if (row.used, row.network) != (task.used, task.network):
                continue
            tested = result["noise"][f"{row.sigma:g}"]
            for method, errors in tested["errors"].items():
                records.append(
                    {
                        "row": row.label,
                        "split": str(task.split),
                        "seed": task.seed,
                        "used": row.used,
                        "network": row.network,
                        "sigma": row.sigma,
                        "method": method,
                        **errors,
                        "ratio": tested["errors"]["classical"]["rmse_m"] / errors["rmse_m"],
                        **{f"frames_{k}": v for k, v in result["frames"].items()},
                        **result["cost"].get(method, {}),
                        "answer_ms": tested["answer_ms"].get(method),
                        **({f"region_{k}": v for k, v in tested["region"].items()} if method == "smoothed" else {}),
                    }
                )
    return records


def main_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> str:
    """Markdown: the paper's table, with its numbers beside ours."""
    lines = [
        "| condition | conformal, m | degrees | classical, m | degrees | ratio | same smoother: ratio "
        "| best other: ratio | whole pose covered | set length | intervals | size against error "
        "| paper: ratio (m / m) |",
        "| --- " * 13 + "|",
    ]
    for row in rows:
        cells = [row.label]
        for method in ("smoothed", "classical"):
            cells += [_of(records, row, split, method, "rmse_m", 4), _of(records, row, split, method, "rmse_deg", 2)]
        ratios = _ratios(records, row, split)
        cells += [_spread(ratios["classical"], 2), _spread(ratios["classical_smoothed"], 2)]
        others = {m: v for m, v in ratios.items() if m in METHODS and m not in _OURS and not m.startswith("classical")}
        best = min(others, key=lambda m: float(np.median(others[m])))
        cells.append(f"{_spread(others[best], 2)} {METHODS[best]}")
        cells.append(_of(records, row, split, "smoothed", "region_joint_coverage", 2))
        cells.append(_spread([float(np.mean(v)) for v in _values(records, row, split, "smoothed", "region_length")], 2))
        cells.append(_of(records, row, split, "smoothed", "region_intervals", 2))
        cells.append(_of(records, row, split, "smoothed", "region_size_error_rank_correlation", 2))
        paper = row.paper_classical / row.paper_conformal
        cells.append(f"{paper:.1f} ({row.paper_classical:g} / {row.paper_conformal:g})")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def method_table(rows: Sequence[Row], records: Sequence[Record], split: str) -> str:
    """Markdown: every method's position RMSE in every row."""
    labels = [row.label for row in rows]
    lines = [f"| method | {' | '.join(labels)} |", "| --- " * (len(labels) + 1) + "|"]
    for method, name in METHODS.items():
        cells = [_of(records, row, split, method, "rmse_m", 4) for row in rows]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


_OURS = ("smoothed", "viterbi", "greedy", "softmax_mean", "online")


def _values(records: Sequence[Record], row: Row, split: str, method: str, key: str) -> list[Any]:
    wanted = (row.label, split, method)
    found = [r.get(key) for r in records if (r["row"], r["split"], r["method"]) == wanted]
    return [v for v in found if v is not None]


def _of(records: Sequence[Record], row: Row, split: str, method: str, key: str, digits: int) -> str:
    return _spread(_values(records, row, split, method, key), digits)


def _ratios(records: Sequence[Record], row: Row, split: str) -> dict[str, list[float]]:
    """Error of every other method over ours, seed by seed."""
    ours = _values(records, row, split, "smoothed", "rmse_m")
    methods = dict.fromkeys(r["method"] for r in records)
    return {
        m: [theirs / mine for theirs, mine in zip(_values(records, row, split, m, "rmse_m"), ours, strict=True)]
        for m in methods
    }


def _spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds."""
    if not values:
        return ""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"
