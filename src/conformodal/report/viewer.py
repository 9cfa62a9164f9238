"""The part of the page that moves: the records of a run, frame by frame."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.results import records_hold

from .page_frames import describe_run, kind_of, page_frame

with require_extra("run", "a page of results"):
    import cv2

MOST_FRAMES = 1000
_WIDTH, _QUALITY = 200, 60  # of a thumbnail
# In this order they are one script; a later one uses names of the earlier ones.
_SCRIPTS = ("data", "drawing", "plan", "space", "charts", "words", "player")


class Thumbnails:
    """JPEG thumbnails of a source by frame name, spread evenly over all frames so far.

    When there are more than `most`, every other one is dropped, and from then on half as many are taken.
    """

    def __init__(self, most: int = MOST_FRAMES, width: int = _WIDTH) -> None:
        self.most, self.width = most, width
        self.jpegs: dict[str, bytes] = {}
        self._stride, self._n_offered = 1, 0

    def add(self, name: str, image: UInt8Array) -> None:
        """Offer the next frame, (h, w, 3) RGB."""
        if self._n_offered % self._stride == 0:
            height = max(1, round(image.shape[0] * self.width / image.shape[1]))
            small = cv2.resize(image, (self.width, height), interpolation=cv2.INTER_AREA)
            bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
            done, data = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
            if done:
                self.jpegs[name] = data.tobytes()
            if len(self.jpegs) > self.most:
                self.jpegs = {name: data for i, (name, data) in enumerate(self.jpegs.items()) if i % 2 == 0}
                self._stride *= 2
        self._n_offered += 1


def make_viewer(
    records: Sequence[dict[str, Any]],
    trajectories: Mapping[str, Trajectory],
    truth: Trajectory | None = None,
    images: Mapping[str, bytes] | None = None,
    level: float | None = None,
    walls: Sequence[FloatArray] = (),
) -> dict[str, Any]:
    """What the template of a run's viewer needs; of long runs, it shows at most a thousand frames, evenly spread.

    Parameters
    ----------
    records, trajectories, truth
        Of all frames; the first trajectory is the answer. A truth of some of the frames is not shown.
    images
        JPEG data by frame name: where there are some, the frames shown are among these.
    level
        The p-value at or below which an image shows no known place.
    walls
        (2, 2) segments, drawn where the plan shows x and y.
    """
    n, images = len(records), images or {}
    answer, classical, online = (
        next(iter(trajectories.values())),
        trajectories.get("classical"),
        trajectories.get(ONLINE),
    )
    truth = truth if truth is not None and len(truth) == n else None
    holds_pose = records_hold(records, answer, None)
    holds_truth = np.zeros(n, dtype=np.bool_) if truth is None else records_hold(records, truth, None)
    stride = max(1, -(-n // MOST_FRAMES))
    shown, kinds, bounded = [], Counter[str](), np.zeros(n, dtype=np.bool_)
    for i, record in enumerate(records):
        row = slice(i, i + 1)
        paths = [None if path is None else path[row] for path in (truth, classical)]
        frame = page_frame(
            record, answer[row], *paths, holds_pose=bool(holds_pose[i]), holds_truth=bool(holds_truth[i])
        )
        kinds[kind_of(frame)] += 1
        bounded[i] = truth is not None and frame["size"] is not None
        if frame["n"] in images:
            shown.append({**frame, "img": base64.b64encode(images[frame["n"]]).decode()})
        elif not images and i % stride == 0:
            shown.append(frame)
    rmse_m = {}
    if truth is not None:
        if online is not None:
            rmse_m["when a frame comes"] = trajectory_errors(online, truth)["rmse_m"]
        rmse_m["as shown here"] = trajectory_errors(answer, truth)["rmse_m"]
    flat = sorted(np.argsort(-np.ptp(answer.positions_xyz, axis=0))[:2].tolist())
    data = {
        "frames": shown,
        "axes": flat,
        "up": ({0, 1, 2} - set(flat)).pop(),
        "truth": truth is not None,
        "classical": classical is not None,
        "level": level,
        "walls": [np.round(wall, 3).tolist() for wall in walls] if flat == [0, 1] else [],
    }
    return {
        "json": json_in_script(data),
        "script": _script(),
        "text": describe_run(kinds, int(bounded.sum()), int(holds_truth[bounded].sum()), rmse_m),
        "note": "" if len(shown) == n else f"{len(shown)} of {counted(n, 'frame')} are shown, evenly spread.",
        "n_shown": len(shown),
        "has_images": bool(images),
        "truth": truth is not None,
        "classical": classical is not None,
        "online": online is not None,
        "known": any(frame["kp"] is not None for frame in shown),
        "path_places": any("pb" in frame for frame in shown),
    }


def json_in_script(data: Any) -> str:
    """JSON for a script element of a page: no name in it can end the element, or hide what follows in a comment."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)  # ASCII, so without line separators of Unicode
    return text.translate({ord(c): f"\\u{ord(c):04x}" for c in "<>&"})


def _script() -> str:
    """The files of the script as one function, so that none of its names is the page's."""
    folder = files("conformodal.report").joinpath("templates", "viewer")
    parts = [folder.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in _SCRIPTS]
    return "\n".join(['"use strict";', "(() => {", *parts, "})();"])
