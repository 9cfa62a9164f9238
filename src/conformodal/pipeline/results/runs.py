"""Results on disk: trajectories in TUM format, regions as JSON Lines, numbers in ``metrics.json``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from conformodal.core.files import write_whole
from conformodal.geometry import Trajectory
from conformodal.io.pose_files import read_tum
from conformodal.io.pose_text import TrajectoryFileError
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.config import Method
from conformodal.pipeline.errors import ResultsError
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.model import METHODS, ONLINE, PAPERS_METHOD

from .folders import check_owner
from .records import METRICS, TRAJECTORY, places_of, region_record
from .writer import ResultsWriter


def write_run(
    folder: Path, run: OdometryRun, frame_names: Sequence[str], truth: Trajectory | None, command: str = "run"
) -> None:
    """Write a run as :class:`~conformodal.pipeline.results.writer.ResultsWriter` does.

    `frame_names` and `truth` are names and true poses of the answered frames.
    """
    with ResultsWriter(folder, command, run.answer) as writer:
        for name, trajectory in run.trajectories.items():
            writer.poses(name, trajectory)
        if truth is not None:
            writer.truth(truth)
        reliable, path = run.reliable.tolist(), run.path_regions.get(ONLINE)
        for i, name in enumerate(frame_names):
            place_p = run.estimates[i].places[0].probability if run.estimates[i].places else None
            frame = name, float(run.timestamps_s[i]), run.motions[i], run.regions.intervals(i)
            record = region_record(
                *frame,
                float(run.known_p[i]),
                EvidenceType(int(run.kinds[i])),
                place_p,
                reliable=reliable[i],
                places=places_of(run.regions[i : i + 1]),
                path_places=None if path is None else places_of(path[i : i + 1]),
            )
            writer.region(record)


def read_trajectories(folder: Path) -> dict[str, Trajectory]:
    """All trajectories of a run's folder, the answer first."""
    found = {_answer_of(folder): read_tum(folder / TRAJECTORY)}
    for path in sorted((folder / "methods").glob("*.tum")):
        found[path.stem] = read_tum(path)
    return found


def read_unfinished(folder: Path) -> dict[str, Trajectory]:
    """The trajectories that a killed run left, as far as they are whole; without those that hold no pose yet."""
    found = {}
    named = {_answer_of(folder): folder / TRAJECTORY} | {p.stem: p for p in sorted((folder / "methods").glob("*.tum"))}
    for name, path in named.items():
        with suppress(TrajectoryFileError), TemporaryDirectory() as scratch:
            text = path.read_text(encoding="utf-8") if path.is_file() else ""
            whole = Path(scratch) / path.name
            whole.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")  # the last line may be half a pose
            found[name] = read_tum(whole)
    return found


def _answer_of(folder: Path) -> str:
    """The method whose poses are the answer, as the metrics beside them tell."""
    with suppress(OSError, ValueError, RecursionError, KeyError, TypeError):
        if json.loads((folder / METRICS).read_text(encoding="utf-8"))["configuration"]["method"] == Method.PAPER:
            return PAPERS_METHOD
    return METHODS[0]


def write_metrics(folder: Path, metrics: dict[str, Any]) -> Path:
    """Write ``metrics.json``; returns its path."""
    if "command" in metrics:
        check_owner(folder, metrics["command"])
    path = folder / METRICS
    write_whole(path, json.dumps(metrics, indent=1, allow_nan=False) + "\n")
    return path


def read_metrics(folder: Path) -> dict[str, Any]:
    """Read ``metrics.json``."""
    path = folder / METRICS
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_number)
    except (OSError, ValueError, RecursionError) as exc:
        raise ResultsError(f"{path}: cannot be read as metrics: {exc}") from exc
    if not isinstance(metrics, dict):
        raise ResultsError(f"{path}: holds {type(metrics).__name__}, expected an object")
    for name in ("results", "configuration"):
        if not isinstance(metrics.get(name) or {}, dict):
            raise ResultsError(f"{path}: {name} is {str(metrics[name])[:80]}, expected an object")
    sign = metrics.get("sign_reference_quat_wxyz")
    if sign is not None and not (
        isinstance(sign, list) and len(sign) == 4 and any(sign) and all(type(v) in (int, float) for v in sign)
    ):
        raise ResultsError(f"{path}: sign_reference_quat_wxyz is {str(sign)[:80]}, expected four numbers")
    return metrics


def _no_number(name: str) -> float:
    raise ValueError(f"holds {name}, which is no number of JSON")
