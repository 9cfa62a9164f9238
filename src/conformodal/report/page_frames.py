"""What the page shows of each frame, and sentences about a frame and about a whole run."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice, product
from math import inf
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, angle_between_quats
from conformodal.localizer.region_rules import EvidenceType

Intervals = list[list[float | None]]
_MOST_BOXES = 64  # of a region that is a product


def page_frame(
    record: dict[str, Any],
    pose: Trajectory,
    truth: Trajectory | None = None,
    classical: Trajectory | None = None,
    *,
    holds_pose: bool = True,
    holds_truth: bool = False,
) -> dict[str, Any]:
    """What the page's script reads of a frame; short names, because there are a thousand frames.

    `record` is that of its region; an end of an interval that is None has no bound. `pose` is the answer, `classical`
    that of the regressor on the same features; trajectories are of one pose. `holds_pose` and `holds_truth` are whether
    the region contains these.
    """
    place, quat = pose.positions_xyz[0], pose.orientations_quat_wxyz[0]
    parts: list[Intervals] = [record["intervals"][axis] for axis in "xyz"]
    lengths = [sum(_lengths(intervals)) for intervals in parts]
    if record["places"] is None:  # a region that is a product
        boxes = [[*box, None] for box in islice(product(*parts), _MOST_BOXES)]
    else:
        boxes = _position_boxes(record["places"])
    frame: dict[str, Any] = {
        "n": record["frame"],
        "t": round(record["timestamp_s"], 4),
        "ok": record["reliable"],
        "m": record["motion"],
        "kp": record["known_p"],
        "ev": record["evidence"],
        "p": _rounded(place),
        "q": _rounded(quat),
        "iv": [[[None if e is None else round(e, 4) for e in part] for part in intervals] for intervals in parts],
        "bx": boxes,
        "size": None if inf in lengths else round(float(np.linalg.norm(lengths)), 4),
        "whole": all(intervals == [[None, None]] for intervals in parts),
    }
    if record["path_places"] is not None:
        frame["pb"] = _position_boxes(record["path_places"])
    if record["place_p"] is not None:
        frame["pp"] = record["place_p"]
    if classical is not None:
        frame["classical"] = _rounded(classical.positions_xyz[0])
    if truth is not None:
        true, true_quat = truth.positions_xyz[0], truth.orientations_quat_wxyz[0]
        frame |= {"truth": _rounded(true), "held": holds_truth}
        frame["err"] = round(float(np.linalg.norm(place - true)), 5)
        frame["deg"] = round(float(np.degrees(angle_between_quats(quat, true_quat))), 4)
        if classical is not None:
            frame["cerr"] = round(float(np.linalg.norm(classical.positions_xyz[0] - true)), 5)
    return {**frame, "say": _describe_frame(frame, holds_pose=holds_pose)}


def kind_of(frame: dict[str, Any]) -> str:
    """What the region of a frame names, in a word or two."""
    if frame["ev"] == EvidenceType.UNKNOWN.name.lower():
        return "unknown place"
    if frame["whole"]:
        return "unbounded"
    n_places = len(frame["bx"])
    return "empty" if not n_places else "one place" if n_places == 1 else "several places"


def describe_run(kinds: Mapping[str, int], n_bounded: int, n_held: int, rmse_m: Mapping[str, float]) -> str:
    """The whole run in words: frames by :func:`kind_of`, bounded regions that hold the truth, and RMSE by name."""
    lines = [f"{counted(sum(kinds.values()), 'frame')}: {', '.join(f'{kind} in {n}' for kind, n in kinds.items())}."]
    if n_bounded:
        lines.append(f"{n_held} of {counted(n_bounded, 'bounded region')} contain the true pose.")
    if rmse_m:
        lines.append(f"Position RMSE: {', '.join(f'{value:.3f} m {name}' for name, value in rmse_m.items())}.")
    return " ".join(lines)


def _describe_frame(frame: dict[str, Any], *, holds_pose: bool) -> str:
    """A frame in words: the region first, then the chosen pose."""
    kind = kind_of(frame)
    bounded = kind in ("one place", "several places")
    if bounded:
        size = " x ".join(f"{max(_lengths(intervals)):.3f}" for intervals in frame["iv"])
        lines = [f"The region names {counted(len(frame['bx']), 'place')}, {size} m at most."]
        if not holds_pose:
            lines.append("The chosen pose lies outside it.")
    else:
        p = "" if frame["kp"] is None else f" (p = {frame['kp']:.2g})"
        lines = [f"Unknown place{p}: the region is unbounded." if kind == "unknown place" else f"The region is {kind}."]
    if "truth" in frame:
        held = f", which the region {'contains' if frame['held'] else 'misses'}" if bounded else ""
        lines.append(f"The chosen pose is {frame['err']:.3f} m and {frame['deg']:.2f} degrees from the true one{held}.")
    return " ".join(lines)


def _position_boxes(places: list[dict[str, Any]]) -> list[list[Any]]:
    """Intervals along x, y and z, and the probability; places that differ in orientation alone are one."""
    boxes: dict[str, list[Any]] = {}
    for place in places:
        box = [[None if e is None else round(e, 4) for e in part] for part in place["box"][:3]]
        boxes.setdefault(str(box), [*box, 0.0])[3] += place["p"]
    return sorted(boxes.values(), key=lambda box: -float(box[3]))


def _lengths(intervals: Intervals) -> list[float]:
    """Of intervals; infinite without a bound."""
    return [inf if low is None or high is None else high - low for low, high in intervals]


def _rounded(values: FloatArray) -> list[float]:
    return [round(float(v), 4) for v in values]
