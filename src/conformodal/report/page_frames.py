"""What the page shows of each frame, and sentences about a frame and about a whole run."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
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
_UNUSABLE = ("lost", "too_few_corners", "inconsistent")  # motion


@dataclass(frozen=True, eq=False)
class Paths:
    """Trajectories of the same frames."""

    answer: Trajectory
    truth: Trajectory | None = None
    classical: Trajectory | None = None  # of the regressor on the same features
    online: Trajectory | None = None  # the answer as a robot gets it, frame by frame


def page_frame(i: int, record: dict[str, Any], paths: Paths) -> dict[str, Any]:
    """What the page's script reads of the i-th frame of a run; short names, because there are a thousand frames.

    `record` is that of its region. An end of an interval that is None has no bound; so has the size.
    """
    place, quat = paths.answer.positions_xyz[i], paths.answer.orientations_quat_wxyz[i]
    parts: list[Intervals] = [record["intervals"][axis] for axis in "xyz"]
    lengths = [sum(_lengths(intervals)) for intervals in parts]
    if record.get("places") is None:  # a region that is a product, and runs of earlier versions
        boxes = [[*box, None] for box in islice(product(*parts), _MOST_BOXES)]
    else:
        boxes = _position_boxes(record["places"])
    frame: dict[str, Any] = {
        "n": record["frame"],
        "t": round(record["timestamp_s"], 4),
        "ok": record["reliable"],
        "m": record["motion"],
        "p": _rounded(place),
        "q": _rounded(quat),
        "iv": [[[None if e is None else round(e, 4) for e in part] for part in intervals] for intervals in parts],
        "bx": boxes,
        "size": None if inf in lengths else round(float(np.linalg.norm(lengths)), 4),
        "whole": all(intervals == [[None, None]] for intervals in parts),
    }
    if record.get("path_places") is not None:
        frame["pb"] = _position_boxes(record["path_places"])
    if record.get("evidence") is not None:  # these are missing in runs of earlier versions
        frame |= {"kp": record.get("known_p"), "ev": record["evidence"]}
    if record.get("place_p") is not None:
        frame["pp"] = record["place_p"]
    if paths.classical is not None:
        frame["classical"] = _rounded(paths.classical.positions_xyz[i])
    if paths.truth is not None:
        true, turned = paths.truth.positions_xyz[i], paths.truth.orientations_quat_wxyz[i]
        frame |= {"truth": _rounded(true), "held": _holds(boxes, true)}
        frame["err"] = round(float(np.linalg.norm(place - true)), 5)
        frame["deg"] = round(float(np.degrees(angle_between_quats(quat, turned))), 4)
        if paths.classical is not None:
            frame["cerr"] = round(float(np.linalg.norm(paths.classical.positions_xyz[i] - true)), 5)
    return {**frame, "say": describe_frame(frame)}


def with_image(frame: dict[str, Any], images: Mapping[str, bytes]) -> dict[str, Any]:
    """A frame with its JPEG data, if there is some of its name."""
    if frame["n"] not in images:
        return frame
    return {**frame, "img": base64.b64encode(images[frame["n"]]).decode()}


def kind_of(frame: dict[str, Any]) -> str:
    """What the region of a frame names, in a word or two."""
    if frame.get("ev") == EvidenceType.UNKNOWN.name.lower():
        return "unknown place"
    if frame["whole"]:
        return "unbounded"
    n_places = len(frame["bx"])
    return "empty" if not n_places else "one place" if n_places == 1 else "several places"


def describe_frame(frame: dict[str, Any]) -> str:
    """A frame in words: the region first, then the chosen pose."""
    parts, kind, n_places = frame["iv"], kind_of(frame), len(frame["bx"])
    bounded = kind in ("one place", "several places")
    if bounded:
        open_axes = [axis for axis, intervals in zip("xyz", parts, strict=True) if inf in _lengths(intervals)]
        size = " x ".join(f"{max(_lengths(intervals)):.3f}" for intervals in parts)
        size = f"without bounds along {', '.join(open_axes)}" if open_axes else f"{size} m at most"
        lines = [f"The region names {counted(n_places, 'place')}, {size}."]
    else:
        p = "" if frame.get("kp") is None else f" (p = {frame['kp']:.2g})"
        lines = [f"Unknown place{p}: the region is unbounded." if kind == "unknown place" else f"The region is {kind}."]
    if bounded and not _holds(frame["bx"], frame["p"]):
        lines.append("The chosen pose lies outside it.")
    if "truth" in frame:
        held = f", which the region {'contains' if frame['held'] else 'misses'}" if bounded else ""
        lines.append(f"The chosen pose is {frame['err']:.3f} m and {frame['deg']:.2f} degrees from the true one{held}.")
    if "pp" in frame and not frame["ok"] and kind != "unknown place":
        lines.append(f"When the frame came, its most probable place had a probability of {frame['pp']:.3f}.")
    if frame["m"] in _UNUSABLE and kind != "unknown place":
        lines.append(f"The motion since the frame before is not reliable ({frame['m'].replace('_', ' ')}).")
    return " ".join(lines)


def describe_run(kinds: Mapping[str, int], n_bounded: int, n_held: int, rmse_m: Mapping[str, float]) -> str:
    """The whole run in words: frames by :func:`kind_of`, bounded regions that hold the truth, and RMSE by name."""
    lines = [f"{counted(sum(kinds.values()), 'frame')}: {', '.join(f'{kind} in {n}' for kind, n in kinds.items())}."]
    if n_bounded:
        lines.append(f"{n_held} of {counted(n_bounded, 'bounded region')} contain the true position.")
    if rmse_m:
        lines.append(f"Position RMSE: {', '.join(f'{value:.3f} m {name}' for name, value in rmse_m.items())}.")
    return " ".join(lines)


def _holds(boxes: list[list[Any]], place_xyz: FloatArray) -> bool:
    """Whether a region holds a position."""
    return any(
        all(
            (low is None or low <= v) and (high is None or v <= high)
            for (low, high), v in zip(box[:3], place_xyz, strict=True)
        )
        for box in boxes
    )


def _position_boxes(places: list[dict[str, Any]]) -> list[list[Any]]:
    """Intervals along x, y and z, and the probability; places that differ in orientation alone are one."""
    found: dict[str, list[Any]] = {}
    for place in places:
        box = [[None if e is None else round(e, 4) for e in part] for part in place["box"][:3]]
        found.setdefault(str(box), [*box, 0.0])[3] += place["p"]
    return sorted(found.values(), key=lambda box: -float(box[3]))


def _lengths(intervals: Intervals) -> list[float]:
    """Of intervals; infinite without a bound."""
    return [inf if low is None or high is None else high - low for low, high in intervals]


def _rounded(values: FloatArray) -> list[float]:
    return [round(float(v), 4) for v in values]
