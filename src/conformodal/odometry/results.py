"""Results on disk: trajectories in TUM format, regions as JSON Lines, numbers in ``metrics.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.poses import Trajectory, read_tum, write_tum

from .errors import ResultsError
from .estimator import METHODS, OdometryRun
from .targets import TARGET_NAMES, pose_targets

REGIONS, METRICS, TRAJECTORY, TRUTH = "regions.jsonl", "metrics.json", "trajectory.tum", "truth.tum"


def write_run(folder: Path, run: OdometryRun, frame_names: Sequence[str], truth: Trajectory | None) -> None:
    """Write a run: ``trajectory.tum`` (the answer), ``regions.jsonl``, ``methods/NAME.tum`` and ``truth.tum``.

    Parameters
    ----------
    folder
        Created if missing.
    run
        What to write.
    frame_names
        Names of the answered frames.
    truth
        True poses of the answered frames, if known.
    """
    (folder / "methods").mkdir(parents=True, exist_ok=True)
    write_tum(folder / TRAJECTORY, run.trajectory)
    for name, trajectory in run.trajectories.items():
        if name != METHODS[0]:
            write_tum(folder / "methods" / f"{name}.tum", trajectory)
    if truth is not None:
        write_tum(folder / TRUTH, truth)
    with (folder / REGIONS).open("w", encoding="utf-8") as file:
        for i, name in enumerate(frame_names):
            file.write(json.dumps(_region_record(run, i, name)) + "\n")


def _region_record(run: OdometryRun, i: int, name: str) -> dict[str, Any]:
    motion = run.motions[i]
    intervals = run.regions.intervals(i)
    return {
        "timestamp_s": round(float(run.timestamps_s[i]), 6),
        "frame": name,
        "reliable": bool(motion is None or motion.reliable),
        "motion": "first" if motion is None else str(motion.status),
        # [null, null] is the whole line; [] an empty set
        "intervals": {
            target: [[_bound(a), _bound(b)] for a, b in parts]
            for target, parts in zip(TARGET_NAMES, intervals, strict=True)
        },
    }


def _bound(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def read_region_records(path: Path) -> list[dict[str, Any]]:
    """Records of ``regions.jsonl``.

    Raises
    ------
    ResultsError
        If the file is missing or a line is no such record; names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as exc:
        raise ResultsError(f"{path}: cannot be read: {exc.strerror}") from exc
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            if set(record["intervals"]) != set(TARGET_NAMES) or not math.isfinite(record["timestamp_s"]):
                raise KeyError("intervals")
        except (ValueError, KeyError, TypeError) as exc:
            raise ResultsError(f"{path}, line {number}: is no region record: {exc}") from exc
        records.append(record)
    return records


def records_contain(
    records: Sequence[dict[str, Any]], truth: Trajectory, sign_reference: npt.NDArray[np.float64]
) -> npt.NDArray[np.bool_]:
    """Whether stored intervals hold the true poses, (n, 7)."""
    targets = pose_targets(truth, sign_reference)
    inside = np.zeros(targets.shape, dtype=np.bool_)
    for i, record in enumerate(records):
        for j, name in enumerate(TARGET_NAMES):
            inside[i, j] = any(
                (a is None or a <= targets[i, j]) and (b is None or targets[i, j] <= b)
                for a, b in record["intervals"][name]
            )
    return inside


def read_trajectories(folder: Path) -> dict[str, Trajectory]:
    """All trajectories of a run's folder, the answer first.

    Raises
    ------
    TrajectoryFileError
        If ``trajectory.tum`` is missing, or one is damaged.
    """
    found = {METHODS[0]: read_tum(folder / TRAJECTORY)}
    for path in sorted((folder / "methods").glob("*.tum")):
        found[path.stem] = read_tum(path)
    return found


def write_metrics(folder: Path, metrics: dict[str, Any]) -> Path:
    """Write ``metrics.json``; returns its path."""
    path = folder / METRICS
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(metrics, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path


def read_metrics(folder: Path) -> dict[str, Any]:
    """Read ``metrics.json``.

    Raises
    ------
    ResultsError
        If it is missing or no JSON object.
    """
    path = folder / METRICS
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as exc:
        raise ResultsError(f"{path}: cannot be read as metrics: {exc}") from exc
    if not isinstance(metrics, dict):
        raise ResultsError(f"{path}: holds {type(metrics).__name__}, expected an object")
    return metrics
