"""Results of a run: records of regions in memory, the files that hold them, and whose a folder of files is."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np

from conformodal.conformal import ConformodalError
from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.files import naming_file, read_file, write_whole
from conformodal.core.words import finite_or_none
from conformodal.geometry import TARGET_NAMES, Trajectory, pose_targets
from conformodal.io.folders import FolderError, writing_in
from conformodal.io.pose_files import TUM_HEADER, read_tum, tum_lines
from conformodal.localizer.observations import Place
from conformodal.localizer.regions import EvidenceType, PoseRegions, boxes_hold

from .config import Method
from .estimates import Estimate
from .model import METHODS, PAPERS_METHOD

REGIONS, METRICS, TRAJECTORY, TRUTH = "regions.jsonl", "metrics.json", "trajectory.tum", "truth.tum"
PAGE = "report.html"
UNFINISHED = ".part"  # follows the name of a file that a run has not finished, or was killed before it had
WORST_SCORE = 1e300  # stands for an infinite score, which JSON does not have
_ANY_SIGN = np.array([1.0, 0.1, 0.01, 0.001])  # tells q from -q
# The files of each command. The first tells whose a folder is that has no metrics; commands that run others come first.
_FILES: dict[str, tuple[str, ...]] = {
    "demo": ("corridor", "model", PAGE),
    "train": ("model.json",),
    "extend": ("model.json",),
    "run": (REGIONS, TRAJECTORY, TRUTH, PAGE),
}


class ResultsError(ConformodalError):
    """A folder of results that is missing something or cannot be read; names the file."""


# ---- records of regions


def record_of(name: str, estimate: Estimate, score: float | None = None, recording: int = 0) -> dict[str, Any]:
    """The record of a frame, one line of ``regions.jsonl``, from its estimate, which has a region.

    `score` is the nonconformity score of the true pose, where it is known; `recording` the number of the recording in
    the source.
    """
    region, evidence, motion = estimate.region, estimate.evidence, estimate.relative_motion
    assert region is not None
    assert evidence is not None
    return {
        "timestamp_s": round(float(estimate.timestamp_s), 6),
        "frame": name,
        "recording": recording,
        "reliable": estimate.reliable and evidence is not EvidenceType.UNKNOWN,
        # of the chosen place, when the frame came
        "place_p": float(f"{estimate.places[0].probability:.4g}") if estimate.places else None,
        "known_p": None if estimate.known_p is None else float(f"{estimate.known_p:.4g}"),
        "evidence": evidence.name.lower(),
        # by the image's belief, of a world of several rooms; 0 of one
        "room": 0 if estimate.localization is None else int(estimate.localization.rooms[0]),
        "motion": "first" if motion is None else str(motion.status),
        "score": None if score is None else float(f"{min(score, WORST_SCORE):.8g}"),
        # [null, null] is the whole line; [] an empty set
        "intervals": {name: _ends(parts) for name, parts in zip(TARGET_NAMES, region.intervals(0), strict=True)},
        "places": _place_records(region),
        "path_places": _place_records(estimate.path_region),
    }


def _place_records(region: PoseRegions | None) -> list[dict[str, Any]] | None:
    """The places of a frame's region (length 1); None of a region that is a product."""
    return None if region is None or region.product else [_place_record(place) for place in region.places(0)]


def _place_record(place: Place) -> dict[str, Any]:
    assert place.box is not None
    return {
        "p": float(f"{place.probability:.4g}"),
        "position_xyz": place.position_xyz.round(6).tolist(),
        "orientation_quat_wxyz": place.orientation_quat_wxyz.round(6).tolist(),
        "sigma_m": place.position_spreads.round(6).tolist(),
        "sigma_rad": round(place.orientation_spread_rad, 6),
        "box": _ends(place.box),
    }


def _ends(intervals: FloatArray) -> list[list[float | None]]:
    """Ends of intervals (m, 2); None where there is no bound."""
    return [[finite_or_none(low), finite_or_none(high)] for low, high in intervals]


def record_bounded(record: dict[str, Any]) -> bool:
    """Whether the region of a frame is bounded in every target."""
    return not any(None in part for parts in record["intervals"].values() for part in parts)


def record_size(record: dict[str, Any]) -> list[float]:
    """Lengths of a bounded region in x, y and z: of all its intervals together."""
    return [sum(high - low for low, high in record["intervals"][name]) for name in TARGET_NAMES[:3]]


def intervals_hold(records: Sequence[dict[str, Any]], truth: Trajectory, sign_reference: FloatArray) -> BoolArray:
    """Whether the intervals of each target contain its true value, (n, 7)."""
    targets = pose_targets(truth, sign_reference)
    inside = np.zeros(targets.shape, dtype=np.bool_)
    for i, record in enumerate(records):
        for j, name in enumerate(TARGET_NAMES):
            inside[i, j] = boxes_hold(_as_boxes(record["intervals"][name], 1), targets[i, j])
    return inside


def records_hold(
    records: Sequence[dict[str, Any]], truth: Trajectory, sign_reference: FloatArray | None, places: str = "places"
) -> BoolArray:
    """Whether regions contain the true poses, (n,); `places` are those of the image or ``path_places``.

    A region without places is the product of its intervals. Without a reference, quaternions have either sign.
    """
    if sign_reference is None:
        signs = (_ANY_SIGN, -_ANY_SIGN)
        return np.logical_or(*(records_hold(records, truth, sign, places) for sign in signs))
    held: BoolArray = np.array(intervals_hold(records, truth, sign_reference).all(axis=1))
    for i, (record, target) in enumerate(zip(records, pose_targets(truth, sign_reference), strict=True)):
        boxes = record[places]
        if boxes is not None and (places != "places" or record_bounded(record)):
            ends = [end for place in boxes for end in place["box"]]
            held[i] = boxes_hold(_as_boxes(ends, len(TARGET_NAMES)), target)
    return held


def _as_boxes(intervals: list[list[float | None]], n_targets: int) -> FloatArray:
    return np.array(_infinite(intervals)).reshape(-1, n_targets, 2)


# ---- files


class ResultsWriter:
    """Writes ``regions.jsonl``, ``trajectory.tum`` (the answer), ``methods/NAME.tum`` and ``truth.tum`` as frames come.

    A context: a file has ``.part`` behind its name until :meth:`publish` puts all of them in the place of an earlier
    run's. What a run that is killed had written stays in these; nothing else of it does.
    """

    def __init__(self, folder: Path, answer: str = METHODS[0]) -> None:
        self.folder = folder
        self.answer = answer  # the method whose poses are the answer
        self.n_regions = 0  # written so far
        self._open: dict[str, TextIO] = {}
        (folder / "methods").mkdir(parents=True, exist_ok=True)
        self._remove_unfinished()
        self._write(REGIONS, [])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
        if kind is not None and not self.n_regions:
            self._remove_unfinished()

    def publish(self, metrics: dict[str, Any]) -> None:
        """Put all files of the run, and its metrics, in the place of an earlier run's; what was made from that goes.

        A page that was written to :meth:`unfinished` beforehand goes with them. Nothing of the earlier run is touched
        before all files of this one are complete. Its metrics are replaced last: until then they name other files than
        there are, and :func:`read_run` refuses the folder.
        """
        self._close()
        write_whole(self.unfinished(METRICS), _metrics_text(metrics))
        new = [name for name in (*self._open, PAGE) if self.unfinished(name).exists()]
        for name in new:
            self.unfinished(name).replace(self.folder / name)
        old = [TRUTH, PAGE]
        for pattern in ("methods/*.tum", *(f"evaluation*/{name}" for name in (METRICS, "errors.csv", "errors.svg"))):
            old += [str(path.relative_to(self.folder)) for path in self.folder.glob(pattern)]
        for name in set(old) - set(new):
            (self.folder / name).unlink(missing_ok=True)
        self.unfinished(METRICS).replace(self.folder / METRICS)

    def unfinished(self, name: str) -> Path:
        """Where a file is until it is published."""
        return self.folder / f"{name}{UNFINISHED}"

    def region(self, record: dict[str, Any]) -> None:
        """Write the region of the next frame, from :func:`record_of`."""
        self._write(REGIONS, [json.dumps(record)])
        self.n_regions += 1

    def records(self) -> Iterator[dict[str, Any]]:
        """The records of all regions so far, read from the file one by one: a long run has no room for them."""
        with self.unfinished(REGIONS).open(encoding="utf-8") as file:
            yield from map(json.loads, file)

    def poses(self, method: str, trajectory: Trajectory) -> None:
        """Write the next poses of a method."""
        self._write(TRAJECTORY if method == self.answer else f"methods/{method}.tum", tum_lines(trajectory))

    def truth(self, trajectory: Trajectory) -> None:
        """Write the next true poses."""
        self._write(TRUTH, tum_lines(trajectory))

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the files that the numbers of a run that has ended rest on, before they are published."""
        return {name: _digest(self.unfinished(name)) for name in (REGIONS, TRAJECTORY)}

    def _write(self, name: str, lines: Sequence[str]) -> None:
        with naming_file(self.unfinished(name)):
            if name not in self._open:
                # line buffered, so that others can follow a run
                self._open[name] = self.unfinished(name).open("w", encoding="utf-8", buffering=1)
                lines = [TUM_HEADER, *lines] if name.endswith(".tum") else lines
            for line in lines:
                self._open[name].write(f"{line}\n")

    def _close(self) -> None:
        for name, file in self._open.items():
            with naming_file(self.unfinished(name)):
                file.close()

    def _remove_unfinished(self) -> None:
        for path in [*self.folder.glob(f"*{UNFINISHED}"), *self.folder.glob(f"methods/*{UNFINISHED}")]:
            path.unlink()


def _digest(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``."""
    write_whole(folder / METRICS, _metrics_text(metrics))


def _metrics_text(metrics: dict[str, Any]) -> str:
    return json.dumps(metrics, indent=1, allow_nan=False) + "\n"


def _infinite(parts: list[list[float | None]]) -> list[list[float]]:
    return [[-math.inf if low is None else low, math.inf if high is None else high] for low, high in parts]


# ---- reading


@dataclass(frozen=True, eq=False)
class RunResult:
    """The results of a run as its folder holds them: as many records as poses of each method."""

    metrics: dict[str, Any]
    records: list[dict[str, Any]]
    trajectories: dict[str, Trajectory]  # by method, the answer first
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions in intervals

    @property
    def answer(self) -> Trajectory:
        """The poses of the answer."""
        return next(iter(self.trajectories.values()))


def read_run(folder: Path) -> RunResult:
    """Read the results of a run.

    Raises
    ------
    ResultsError
        If the run was killed, or files are missing, damaged, or not of one run.
    """
    if not (folder / METRICS).exists() and (part := folder / f"{REGIONS}{UNFINISHED}").exists():
        raise ResultsError(f"{folder}: the run was stopped; its regions until then are in {part.name}. Run it again")
    metrics = read_metrics(folder)
    for name, digest in (metrics.get("results") or {}).items():
        if _digest(folder / name) != digest:
            raise ResultsError(f"{folder / name}: is not the file that {METRICS} was written for. Run it again")
    try:
        sign = np.array(metrics["sign_reference_quat_wxyz"], dtype=np.float64).reshape(4)
    except (KeyError, TypeError, ValueError):
        raise ResultsError(f"{folder / METRICS}: sign_reference_quat_wxyz is not four numbers") from None
    result = RunResult(metrics, read_region_records(folder / REGIONS), read_trajectories(folder), sign)
    for name, trajectory in result.trajectories.items():
        if not np.array_equal(trajectory.timestamps_s, result.answer.timestamps_s):
            raise ResultsError(f"{folder}: the poses of {name} have other times than the answer. Run it again")
    if len(result.records) != len(result.answer):
        raise ResultsError(f"{folder}: has {len(result.answer)} poses and {len(result.records)} regions. Run it again")
    return result


def read_region_records(path: Path) -> list[dict[str, Any]]:
    """Records of ``regions.jsonl``; refuses a line that is not such a record, by its number."""
    try:
        lines = read_file(path).decode("utf-8", "surrogateescape").split("\n")
    except OSError as exc:
        raise ResultsError(f"{path}: cannot be read: {exc.strerror}") from exc
    return [_parsed(line, f"{path}, line {number}") for number, line in enumerate(lines, start=1) if line]


def _parsed(line: str, where: str) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads(line)
        if set(record["intervals"]) != set(TARGET_NAMES) or not math.isfinite(record["timestamp_s"]):
            raise KeyError("intervals")
        if not all(isinstance(record[name], str) for name in ("frame", "motion", "evidence")):
            raise TypeError("frame, motion and evidence must be text")
        boxes = [place["box"] for name in ("places", "path_places") for place in record[name] or ()]
        for low, high in [part for parts in (*record["intervals"].values(), *boxes) for part in parts]:
            if not all(end is None or math.isfinite(end) for end in (low, high)):
                raise ValueError(f"an interval ends at {low}, {high}")
        record["reliable"]
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as exc:
        raise ResultsError(f"{where}: is not a region record: {exc}") from exc
    return record


def read_trajectories(folder: Path) -> dict[str, Trajectory]:
    """All trajectories of a run's folder, the answer first."""
    configuration = read_metrics(folder).get("configuration") or {} if (folder / METRICS).exists() else {}
    answer = PAPERS_METHOD if configuration.get("method") == Method.PAPER else METHODS[0]
    paths = {path.stem: path for path in sorted((folder / "methods").glob("*.tum"))}
    return {answer: read_tum(folder / TRAJECTORY)} | {name: read_tum(path) for name, path in paths.items()}


def read_metrics(folder: Path) -> dict[str, Any]:
    """Read ``metrics.json``."""
    path = folder / METRICS
    try:
        metrics = json.loads(read_file(path))
    except FileNotFoundError as exc:
        raise ResultsError(f"{path}: no such file; name the folder of a run's results") from exc
    except (OSError, ValueError, RecursionError) as exc:
        raise ResultsError(f"{path}: cannot be read as metrics: {exc}") from exc
    if not isinstance(metrics, dict) or not isinstance(metrics.get("configuration") or {}, dict):
        raise ResultsError(f"{path}: is not an object with a configuration")
    return metrics


# ---- whose a folder is


@contextmanager
def lock_output(folder: Path, command: str, apart: Iterable[Path] = ()) -> Iterator[None]:
    """Lock a folder for the results of a command, made if missing; no file of anything else would be overwritten.

    Folders `apart` are read; it must not be one of them, or in one.

    Raises
    ------
    FolderError
        If it cannot be written, holds something that is not of this command, is in use, or is, or lies in, one of those
        that are read.
    """
    for other in apart:
        if other.is_dir() and folder.resolve().is_relative_to(other.resolve()):
            raise FolderError(
                f"{folder}: {other} is read from, so results cannot be written in it; take another folder"
            )
    with writing_in(folder):
        owner = _owner(folder)
        if owner not in (None, command):
            raise FolderError(
                f"{folder}: holds results of {owner}, which {command} would overwrite; take another folder, or empty it"
            )
        for name in () if owner else _FILES.get(command, ()):
            if (folder / name).exists():
                raise FolderError(
                    f"{folder / name}: was not written by {command}, which would overwrite it; take another folder"
                )
        yield


def _owner(folder: Path) -> str | None:
    """The command whose results a folder holds, by its metrics, or by the first file that a command writes."""
    try:
        return str(json.loads(read_file(folder / METRICS))["command"]).split()[0]
    except FileNotFoundError:
        return next((who for who, names in _FILES.items() if (folder / names[0]).exists()), None)
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError):
        return "another program"
