"""The part of the page that moves: the records of a run, frame by frame, and a sentence about each."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, product
from math import inf
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray, UInt8Array, evenly_spread
from conformodal.core.extras import require_extra
from conformodal.core.words import counted, length
from conformodal.geometry import Trajectory, angle_between_quats
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.results import records_hold

with require_extra("run", "a page of results"):
    import cv2

MAX_FRAMES = 1000
_WIDTH, _QUALITY = 200, 60  # of a thumbnail
_MAX_BOXES = 64  # of a region that is a product

Intervals = list[list[float | None]]  # an end that is None has no bound


class Thumbnails:
    """JPEG thumbnails of a source by frame name, spread evenly over all frames so far.

    When there are more than :data:`MAX_FRAMES`, every other one is dropped, and from then on half as many are taken.
    """

    def __init__(self) -> None:
        self.jpegs: dict[str, bytes] = {}
        self._stride, self._n_offered = 1, 0

    def add(self, name: str, image: UInt8Array) -> None:
        """Offer the next frame, (h, w, 3) RGB."""
        if self._n_offered % self._stride == 0:
            height = max(1, round(image.shape[0] * _WIDTH / image.shape[1]))
            bgr = cv2.cvtColor(cv2.resize(image, (_WIDTH, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
            self.jpegs[name] = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))[1].tobytes()
            if len(self.jpegs) > MAX_FRAMES:
                self.jpegs = dict(islice(self.jpegs.items(), 0, None, 2))
                self._stride *= 2
        self._n_offered += 1


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a run's path is drawn in."""

    walls: Sequence[FloatArray] = ()  # (2, 2) segments, drawn where the plan shows x and y
    unit: str = "m"  # of lengths
    trained_xyz: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (k, 3) where training frames were


def make_viewer(
    records: Iterable[dict[str, Any]],
    trajectories: Mapping[str, Trajectory],
    truth: Trajectory | None = None,
    images: Mapping[str, bytes] | None = None,
    level: float | None = None,
    surroundings: Surroundings | None = None,
) -> dict[str, Any]:
    """What the template of a run's viewer needs; of long runs, it shows at most a thousand frames, evenly spread.

    The first trajectory is the answer. A truth of some of the frames is not shown. `images` are JPEG data by frame
    name: where there are some, the frames shown are among these. `level` is the p-value at or below which an image
    shows no known place.
    """
    answer, classical = next(iter(trajectories.values())), trajectories.get("classical")
    n, images, around = len(answer), images or {}, surroundings or Surroundings()
    flat = sorted(np.argsort(-np.ptp(answer.positions_xyz, axis=0))[:2].tolist())
    truth = truth if truth is not None and len(truth) == n else None
    stride = max(1, -(-n // MAX_FRAMES))
    chosen = [
        (i, one) for i, one in enumerate(records) if (one["frame"] in images if images else i % stride == 0)
    ]  # the others are let go one by one
    rows = np.array([i for i, _ in chosen], dtype=np.int64)
    answer, truth, classical = (
        answer[rows],
        None if truth is None else truth[rows],
        None if classical is None else classical[rows],
    )
    some = [one for _, one in chosen]
    shown = [_region_of(one) for one in some]
    step_s = _close_gaps(shown)
    _add_poses(shown, answer, truth, classical)
    holds_pose = records_hold(some, answer, None)
    holds_truth = None if truth is None else records_hold(some, truth, None)
    for i, frame in enumerate(shown):
        if holds_truth is not None:
            frame["held"] = bool(holds_truth[i])
        frame["say"] = _describe_frame(frame, around.unit, holds_pose=bool(holds_pose[i]))
        if images:
            frame["img"] = base64.b64encode(images[frame["n"]]).decode()
    data = {
        "frames": shown,
        "step": step_s,
        "trained": around.trained_xyz[evenly_spread(len(around.trained_xyz), MAX_FRAMES)].round(3).tolist(),
        "axes": flat,
        "unit": around.unit,
        "up": ({0, 1, 2} - set(flat)).pop(),
        "truth": truth is not None,
        "classical": classical is not None,
        "level": level,
        "walls": [np.round(wall, 3).tolist() for wall in around.walls] if flat == [0, 1] else [],
    }
    return {
        "data": data,
        "note": "" if len(shown) == n else f"{len(shown)} of {counted(n, 'frame')} are shown, evenly spread.",
        "n_shown": len(shown),
        "has_images": bool(images),
        "truth": truth is not None,
        "classical": classical is not None,
        "online": ONLINE in trajectories,
        "known": any(frame["kp"] is not None for frame in shown),
        "path_places": any("pb" in frame for frame in shown),
    }


def _region_of(record: dict[str, Any]) -> dict[str, Any]:
    """What the page's script reads of a frame's record; short names, because there are a thousand frames."""
    parts: list[Intervals] = [record["intervals"][axis] for axis in "xyz"]
    lengths = [sum(_lengths(intervals)) for intervals in parts]
    if record["places"] is None:  # a region that is a product
        boxes = [[*box, None] for box in islice(product(*parts), _MAX_BOXES)]
    else:
        boxes = _position_boxes(record["places"])
    frame: dict[str, Any] = {
        "n": record["frame"],
        "t": round(record["timestamp_s"], 4),
        "rec": record["recording"],
        "ok": record["reliable"],
        "m": record["motion"],
        "kp": record["known_p"],
        "ev": record["evidence"],
        "iv": [_rounded(intervals) for intervals in parts],
        "bx": boxes,
        "size": None if inf in lengths else round(float(np.linalg.norm(lengths)), 4),
        "whole": all(intervals == [[None, None]] for intervals in parts),
    }
    if record["path_places"] is not None:
        frame["pb"] = _position_boxes(record["path_places"])
    if record["place_p"] is not None:
        frame["pp"] = record["place_p"]
    return frame


def _close_gaps(frames: list[dict[str, Any]]) -> float:
    """Let each recording begin one step after the end of the one before; returns the step, the median one."""
    recording = np.array([frame["rec"] for frame in frames])
    steps = np.diff([frame["t"] for frame in frames])
    within = np.diff(recording) == 0
    step_s = float(np.median(steps[within])) if within.any() else 1.0
    shifts = np.cumsum(np.where(within, 0.0, steps - step_s))
    for frame, shift in zip(frames[1:], shifts.tolist(), strict=True):
        frame["t"] = round(frame["t"] - shift, 4)
    return step_s


def _position_boxes(places: list[dict[str, Any]]) -> list[list[Any]]:
    """Intervals along x, y and z, and the probability; places that differ in orientation alone are one."""
    boxes: dict[str, list[Any]] = {}
    for place in places:
        box = _rounded(place["box"][:3])
        boxes.setdefault(str(box), [*box, 0.0])[3] += place["p"]
    return sorted(boxes.values(), key=lambda box: -float(box[3]))


def _rounded(intervals: Intervals) -> Intervals:
    return [[None if end is None else round(end, 4) for end in interval] for interval in intervals]


def _lengths(intervals: Intervals) -> list[float]:
    """Of intervals; infinite without a bound."""
    return [inf if low is None or high is None else high - low for low, high in intervals]


def _add_poses(
    frames: list[dict[str, Any]], answer: Trajectory, truth: Trajectory | None, classical: Trajectory | None
) -> None:
    """Add the answer, the truth and the regressor's answer to all frames, and errors in metres and degrees."""
    columns = {"p": answer.positions_xyz, "q": answer.orientations_quat_wxyz}
    if classical is not None:
        columns["classical"] = classical.positions_xyz
    if truth is not None:
        columns["truth"] = truth.positions_xyz
        columns["err"] = np.linalg.norm(answer.positions_xyz - truth.positions_xyz, axis=1)
        turned = angle_between_quats(answer.orientations_quat_wxyz, truth.orientations_quat_wxyz)
        columns["deg"] = np.degrees(turned)
        if classical is not None:
            columns["cerr"] = np.linalg.norm(classical.positions_xyz - truth.positions_xyz, axis=1)
    for name, column in columns.items():
        for frame, value in zip(frames, np.round(column, 5 if name in ("err", "cerr") else 4).tolist(), strict=True):
            frame[name] = value


def kind_of(frame: dict[str, Any]) -> str:
    """What the region of a frame names, in a word or two."""
    if frame["ev"] == EvidenceType.UNKNOWN.name.lower():
        return "unknown place"
    if frame["whole"]:
        return "unbounded"
    n_places = len(frame["bx"])
    return "empty" if not n_places else "one place" if n_places == 1 else "several places"


def _describe_frame(frame: dict[str, Any], unit: str, *, holds_pose: bool) -> str:
    """A frame in words: the region first, then the chosen pose."""
    kind = kind_of(frame)
    bounded = kind in ("one place", "several places")
    if bounded:
        size = " x ".join(f"{max(_lengths(intervals)):.3f}" for intervals in frame["iv"])
        most = "up to " if kind == "several places" else ""
        lines = [f"The region is {counted(len(frame['bx']), 'place')} of {most}{size} {unit}."]
        if not holds_pose:
            lines.append("The chosen pose lies outside it.")
    else:
        p = "" if frame["kp"] is None else f" (p = {frame['kp']:.2g})"
        lines = [f"Unknown place{p}: the region is unbounded." if kind == "unknown place" else f"The region is {kind}."]
    if "truth" in frame:
        held = f", which the region {'contains' if frame['held'] else 'misses'}" if bounded else ""
        off = f"{length(frame['err'], unit)} and {frame['deg']:.2f} degrees"
        lines.append(f"The chosen pose is {off} from the true one{held}.")
    return " ".join(lines)
