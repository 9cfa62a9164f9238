"""The part of the page that moves: results of a run, frame by frame, from what lies on disk."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.odometry import iter_region_records
from conformodal.odometry.results.records import REGIONS, TRAJECTORY, TRUTH
from conformodal.poses import Trajectory, orientation_errors_deg, position_errors_m, read_tum

MOST_FRAMES = 1000
_RULERS_M = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)


@dataclass(frozen=True)
class Viewer:
    """What the template needs: data as JSON, the script, and what is there to be shown."""

    json: str
    script: str
    note: str
    has_images: bool
    truth: bool
    classical: bool
    known: bool


def make_viewer(folder: Path, images: Mapping[str, bytes], level: float | None = None) -> Viewer:
    """A viewer of a run's folder; of long runs, it shows at most a thousand frames, evenly spread.

    Parameters
    ----------
    folder
        What ``conformodal run`` wrote.
    images
        JPEG data by frame name. Where there are some, the frames shown are among those that have one.
    level
        P-value at or below which an image shows no place that is known; None draws no line at it.

    Raises
    ------
    ResultsError, TrajectoryFileError
        If files are missing or damaged.
    """
    answer = read_tum(folder / TRAJECTORY)
    truth = _beside(folder / TRUTH, len(answer))
    classical = _beside(folder / "methods" / "classical.tum", len(answer))
    stride = max(1, -(-len(answer) // MOST_FRAMES))
    shown = []
    for i, record in enumerate(iter_region_records(folder / REGIONS)):
        if i < len(answer) and (record["frame"] in images if images else i % stride == 0):
            shown.append(_frame(i, record, answer, truth, classical, images))
    extent = np.ptp(answer.positions_xyz, axis=0)
    flat = sorted(np.argsort(-extent)[:2].tolist())
    up = ({0, 1, 2} - set(flat)).pop()
    ruler = max((r for r in _RULERS_M if r <= max(extent.max() / 3, _RULERS_M[0])), default=_RULERS_M[0])
    data = {"frames": shown, "axes": flat, "up": up, "ruler": ruler, "truth": truth is not None}
    data["classical"] = classical is not None
    data["level"] = level
    known = any("kp" in frame for frame in shown)
    note = "" if len(shown) == len(answer) else f"{len(shown)} of {len(answer)} frames are shown, evenly spread."
    script = files("conformodal.report").joinpath("templates/viewer.js").read_text(encoding="utf-8")
    text = json_in_script(data)
    return Viewer(text, script, note, bool(images), truth is not None, classical is not None, known)


def json_in_script(data: Any) -> str:
    """JSON for a script element of a page: no name in it can end the element, or hide what follows in a comment."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)  # ASCII, so without line separators of Unicode
    return text.translate({ord(c): f"\\u{ord(c):04x}" for c in "<>&"})


def _beside(path: Path, n: int) -> Trajectory | None:
    if not path.is_file():
        return None
    found = read_tum(path)
    return found if len(found) == n else None


def _frame(
    i: int,
    record: dict[str, Any],
    answer: Trajectory,
    truth: Trajectory | None,
    classical: Trajectory | None,
    images: Mapping[str, bytes],
) -> dict[str, Any]:
    parts = [record["intervals"][target] for target in "xyz"]
    bounded = all(None not in part for target in parts for part in target)
    size = float(np.linalg.norm([sum(b - a for a, b in target) for target in parts])) if bounded else None
    one = slice(i, i + 1)
    frame: dict[str, Any] = {
        "n": record["frame"],
        "t": round(record["timestamp_s"], 4),
        "ok": record["reliable"],
        "m": record["motion"],
        "p": _rounded(answer.positions_xyz[i]),
        "q": _rounded(answer.orientations_quat_wxyz[i]),
        "iv": [[[None if e is None else round(e, 4) for e in part] for part in target] for target in parts],
        "size": None if size is None else round(size, 4),
        # nothing but whole lines: there is no box to draw
        "whole": all(target == [[None, None]] for target in parts),
    }
    if "known_p" in record:  # runs of earlier versions have none
        frame |= {"kp": record["known_p"], "ev": record["evidence"]}
    if record["frame"] in images:
        frame["img"] = base64.b64encode(images[record["frame"]]).decode()
    if classical is not None:
        frame["classical"] = _rounded(classical.positions_xyz[i])
    if truth is not None:
        p = truth.positions_xyz[i]
        frame |= {
            "truth": _rounded(p),
            "err": round(float(position_errors_m(answer[one], truth[one])[0]), 5),
            "deg": round(float(orientation_errors_deg(answer[one], truth[one])[0]), 4),
            "held": all(any(_holds(part, v) for part in target) for target, v in zip(parts, p, strict=True)),
        }
        if classical is not None:
            frame["cerr"] = round(float(position_errors_m(classical[one], truth[one])[0]), 5)
    return frame


def _holds(part: list[float | None], value: float) -> bool:
    low, high = part
    return (low is None or low <= value) and (high is None or value <= high)


def _rounded(values: npt.NDArray[np.float64]) -> list[float]:
    return [round(float(v), 4) for v in values]
