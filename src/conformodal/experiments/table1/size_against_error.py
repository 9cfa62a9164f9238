"""Does the size of the region tell the size of the error? Across rows it does; within one both hardly vary."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from conformodal.odometry import Method

from .conditions import Row, TrainingTask
from .summary import Record
from .tables import Table, spread


def rank_correlation(one: npt.ArrayLike, other: npt.ArrayLike) -> float:
    """Spearman's rank correlation of the finite pairs; NaN where either does not vary."""
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    there = np.isfinite(a) & np.isfinite(b)
    a, b = a[there], b[there]
    if len(a) < 2 or not np.ptp(a) or not np.ptp(b):
        return float("nan")
    return float(spearmanr(a, b).statistic)


def size_table(rows: Sequence[Row], tasks: Sequence[TrainingTask], results: Sequence[Record], split: str) -> Table:
    """Rank correlation of the position region's size with the error and with the turning rate, seed by seed.

    Of ours. Frame by frame; and of each condition's mean size with its RMSE, condition by condition.
    """
    frames = {
        (task.seed, task.used, task.network, sigma): result["noise"][f"{sigma:g}"]["frames"]
        for task, result in zip(tasks, results, strict=True)
        if str(task.split) == split and task.method is Method.CONFORMODAL
        for sigma in task.sigmas
    }
    seeds = sorted({seed for seed, *_ in frames})
    noisy = [row for row in rows if row.used == min(r.used for r in rows)]
    groups = {f"noise {min(r.sigma for r in noisy):g} to {max(r.sigma for r in noisy):g}": noisy, "all rows": rows}
    lines = []
    for name, group in groups.items():
        conditions = dict.fromkeys((row.used, row.network, row.sigma) for row in group)
        cells = []
        for other in ("error_m", "turn_rad_s"):
            found = []
            for seed in seeds:
                pooled = [frames[seed, *condition] for condition in conditions]
                size, against = ([v for part in pooled for v in part[key]] for key in ("size_m", other))
                found.append(rank_correlation(size, against))
            cells.append(spread([v for v in found if np.isfinite(v)], 2))
        by_condition = []
        for seed in seeds:
            each = [frames[seed, *condition] for condition in conditions]
            sizes = [np.mean(_known(part["size_m"])) for part in each]
            by_condition.append(
                rank_correlation(sizes, [np.sqrt(np.mean(_known(part["error_m"]) ** 2)) for part in each])
            )
        lines.append([name, *cells, spread([v for v in by_condition if np.isfinite(v)], 2)])
    header = ["frames together", "size against error", "size against turning rate"]
    return Table([*header, "condition by condition: mean size against RMSE"], lines)


def _known(values: Sequence[float | None]) -> npt.NDArray[np.float64]:
    return np.array([v for v in values if v is not None], dtype=np.float64)
