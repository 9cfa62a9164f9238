"""Regions on disk: one JSON object a line."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.ranges import as_member
from conformodal.core.words import finite_or_none
from conformodal.geometry import RelativeMotion, Trajectory
from conformodal.localizer.places import Place
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.targets import TARGET_NAMES, pose_targets
from conformodal.pipeline.errors import ResultsError

REGIONS, METRICS, TRAJECTORY, TRUTH = "regions.jsonl", "metrics.json", "trajectory.tum", "truth.tum"
_ANY_SIGN = [1.0, 0.1, 0.01, 0.001]  # tells q from -q


def region_record(
    name: str,
    timestamp_s: float,
    motion: RelativeMotion | None,
    intervals: Sequence[FloatArray],
    known_p: float | None = None,
    kind: EvidenceType = EvidenceType.GLOBAL,
    place_p: float | None = None,
    *,
    reliable: bool = True,
    places: Sequence[Place] | None = None,
    path_places: Sequence[Place] | None = None,
) -> dict[str, Any]:
    """The record of a frame, see :class:`~conformodal.pipeline.estimates.Estimate`.

    `intervals` are (m, 2) a target, `place_p` the probability of the chosen place when the frame came, `places` and
    `path_places` those of the image's region and of that from the frames so far; None for a region that is a product.
    """
    kind = as_member(kind, EvidenceType, "kind", ResultsError)
    return {
        "timestamp_s": round(float(timestamp_s), 6),
        "frame": name,
        "reliable": reliable and kind is not EvidenceType.UNKNOWN,
        "place_p": None if place_p is None else float(f"{place_p:.4g}"),
        "known_p": None if known_p is None or math.isnan(known_p) else float(f"{known_p:.4g}"),
        "evidence": kind.name.lower(),
        "motion": "first" if motion is None else str(motion.status),
        # [null, null] is the whole line; [] an empty set
        "intervals": {
            target: [[finite_or_none(a), finite_or_none(b)] for a, b in parts]
            for target, parts in zip(TARGET_NAMES, intervals, strict=True)
        },
        "places": None if places is None else [_place_record(place) for place in places],
        "path_places": None if path_places is None else [_place_record(place) for place in path_places],
    }


def places_of(region: PoseRegions | None) -> list[Place] | None:
    """The places of a frame's region (length 1); None of a region that is a product."""
    return None if region is None or region.product else region.places(0)


def _place_record(place: Place) -> dict[str, Any]:
    assert place.box is not None
    return {
        "p": float(f"{place.probability:.4g}"),
        "position_xyz": place.position_xyz.round(6).tolist(),
        "orientation_quat_wxyz": place.orientation_quat_wxyz.round(6).tolist(),
        "sigma_m": place.position_spreads.round(6).tolist(),
        "sigma_rad": round(place.orientation_spread_rad, 6),
        "box": [[finite_or_none(a), finite_or_none(b)] for a, b in place.box],
    }


def read_region_records(path: Path, *, torn: bool = False) -> list[dict[str, Any]]:
    """Records of ``regions.jsonl``; of a `torn` file the last line may be half a record, and is left out then.

    Raises
    ------
    ResultsError
        If the file is missing or a line is no such record; names the line.
    """
    return list(iter_region_records(path, torn=torn))


def iter_region_records(path: Path, *, torn: bool = False) -> Iterator[dict[str, Any]]:
    """The records of ``regions.jsonl`` one after the other, see :func:`read_region_records`."""
    try:
        with path.open(encoding="utf-8", errors="surrogateescape") as file:
            for number, line in enumerate(file, start=1):
                problem, record = _parsed(line)
                if problem is None:
                    yield record
                    continue
                if torn and not line.endswith("\n"):
                    return
                raise ResultsError(f"{path}, line {number}: is no region record: {problem}") from problem
    except OSError as exc:
        raise ResultsError(f"{path}: cannot be read: {exc.strerror}") from exc


def _parsed(line: str) -> tuple[Exception | None, dict[str, Any]]:
    """The record of a line, or why it is none."""
    try:
        record = json.loads(line)
        _check(record)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as exc:
        return exc, {}
    return None, record


def _check(record: dict[str, Any]) -> None:
    if set(record["intervals"]) != set(TARGET_NAMES) or not math.isfinite(record["timestamp_s"]):
        raise KeyError("intervals")
    if not isinstance(record["frame"], str) or not isinstance(record["motion"], str):
        raise TypeError("frame and motion must be text")
    record["reliable"]
    for parts in record["intervals"].values():
        for low, high in parts:
            if (low is not None and not math.isfinite(low)) or (high is not None and not math.isfinite(high)):
                raise ValueError(f"an interval ends at {low}, {high}")
    for place in [*(record.get("places") or []), *(record.get("path_places") or [])]:
        ends = [end for low, high in place["box"] for end in (low, high) if end is not None]
        if len(place["box"]) != len(TARGET_NAMES) or not all(map(math.isfinite, [place["p"], *ends])):
            raise ValueError("a place has another box than of seven intervals")


def record_bounded(record: dict[str, Any]) -> bool:
    """Whether the region of a stored frame is bounded in every target."""
    return not any(None in part for parts in record["intervals"].values() for part in parts)


def records_contain(
    records: Sequence[dict[str, Any]], truth: Trajectory, sign_reference: FloatArray | None
) -> BoolArray:
    """Whether stored intervals hold the true poses, (n, 7).

    Where no reference for the signs of quaternions is known, each frame has the sign that more of its intervals hold.
    """
    if sign_reference is None:
        here, there = (records_contain(records, truth, np.array(sign)) for sign in (_ANY_SIGN, [-v for v in _ANY_SIGN]))
        return np.where(here.sum(axis=1, keepdims=True) >= there.sum(axis=1, keepdims=True), here, there)
    targets = pose_targets(truth, sign_reference)
    inside = np.zeros(targets.shape, dtype=np.bool_)
    for i, record in enumerate(records):
        for j, name in enumerate(TARGET_NAMES):
            inside[i, j] = any(_holds(part, targets[i, j]) for part in record["intervals"][name])
    return inside


def records_hold(
    records: Sequence[dict[str, Any]], truth: Trajectory, sign_reference: FloatArray | None, places: str = "places"
) -> BoolArray:
    """Whether stored regions hold the true poses, (n,); `places` are those of the image or ``path_places``.

    A region without places is the product of its intervals.
    """
    if sign_reference is None:
        here, there = (records_hold(records, truth, np.array(s), places) for s in (_ANY_SIGN, [-v for v in _ANY_SIGN]))
        return here | there
    targets = pose_targets(truth, sign_reference)
    held: BoolArray = np.array(records_contain(records, truth, sign_reference).all(axis=1))
    for i, record in enumerate(records):
        found = record.get(places)
        if found is not None and not (places == "places" and not record_bounded(record)):
            held[i] = any(all(map(_holds, place["box"], targets[i])) for place in found)
    return held


def _holds(interval: Sequence[float | None], value: float) -> bool:
    low, high = interval
    return (low is None or low <= value) and (high is None or value <= high)
