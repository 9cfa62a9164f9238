"""From results of tasks to one tidy record a row, split, seed and method; as JSON and as Parquet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from conformodal.core.files import replacing, write_whole
from conformodal.odometry import Method

from ..baselines import BASELINES
from ..errors import ExperimentError
from .conditions import Row, TrainingTask

METHODS = {
    "paper": "the paper's system",
    "paper_softmax_mean": "the paper's system, softmax mean",
    "paper_plain": "plain regressor, paper's features",
    "paper_classical": "tuned regressor, paper's features",
    "smoothed": "conformal, smoothed",
    "no_landmarks": "conformal, smoothed, without landmarks",
    "viterbi": "conformal, global search",
    "greedy": "conformal, greedy over our intervals",
    "softmax_mean": "softmax mean",
    "plain": "plain regressor",
    "classical": "classical: tuned regressor",
    "classical_smoothed": "classical, same smoother",
    "classical_landmarks": "classical, our landmarks, search and smoother",
    "landmarks": "landmarks alone",
    **{name: kind.label for name, kind in BASELINES.items()},
}
Record = dict[str, Any]
# Names of a method in runs of the paper's system, and in records, where ours are beside them.
_PAPERS = {"greedy": "paper"} | {name: f"paper_{name}" for name in ("softmax_mean", "plain", "classical")}
_ANSWERS = {Method.PAPER: "greedy", Method.CONFORMODAL: "smoothed"}


def tidy(rows: Sequence[Row], tasks: Sequence[TrainingTask], results: Sequence[Record]) -> list[Record]:
    """One record a row, split, seed and method.

    ``ratio`` is the error of the tuned regressor on the same features over the method's.
    """
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
                        "method": _PAPERS[method] if task.method is Method.PAPER else method,
                        **errors,
                        "ratio": tested["errors"]["classical"]["rmse_m"] / errors["rmse_m"],
                        **{f"frames_{k}": v for k, v in result["frames"].items()},
                        **result["cost"].get(method, {}),
                        "answer_ms": tested["answer_ms"].get(method),
                        **(_region(tested["region"]) if method == _ANSWERS[task.method] else {}),
                    }
                )
    return records


def _region(found: Record) -> Record:
    """Numbers about regions in one flat record; ``region_alone_`` are those without local features."""
    own = {f"region_{k}": v for k, v in found.items() if k != "alone"}
    return {**own, **{f"region_alone_{k}": v for k, v in found.get("alone", {}).items()}}


def write_json(records: Sequence[Record], path: Path) -> None:
    """All records, as a list of objects."""
    write_whole(path, json.dumps(list(records), indent=1) + "\n")


def write_parquet(records: Sequence[Record], path: Path) -> None:
    """All records, one row each; what a record does not have is null.

    Raises
    ------
    ExperimentError
        If pyarrow is not installed (extra ``arrow``).
    """
    try:
        import pyarrow as pa  # noqa: PLC0415 - an extra
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ModuleNotFoundError as exc:
        raise ExperimentError("Parquet needs pyarrow: pip install 'conformodal[arrow]'") from exc
    names = dict.fromkeys(name for record in records for name in record)
    with replacing(path) as part:
        pq.write_table(pa.table({name: [record.get(name) for record in records] for name in names}), part)
