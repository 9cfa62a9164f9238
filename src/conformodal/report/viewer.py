"""The part of the page that moves: results of a run, frame by frame, from what lies on disk."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.io.pose_files import read_tum
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.results.records import REGIONS, TRAJECTORY, TRUTH, iter_region_records

from .page_frames import Paths, describe_run, kind_of, page_frame, with_image

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
        self.kept: dict[str, bytes] = {}
        self._stride, self._seen = 1, 0

    def add(self, name: str, image: UInt8Array) -> None:
        """Show it the next frame, (h, w, 3) RGB."""
        if self._seen % self._stride == 0:
            height = max(1, round(image.shape[0] * self.width / image.shape[1]))
            small = cv2.resize(image, (self.width, height), interpolation=cv2.INTER_AREA)
            done, data = cv2.imencode(
                ".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
            )
            if done:
                self.kept[name] = data.tobytes()
            if len(self.kept) > self.most:
                self.kept = {name: data for i, (name, data) in enumerate(self.kept.items()) if i % 2 == 0}
                self._stride *= 2
        self._seen += 1


def make_viewer(
    folder: Path, images: Mapping[str, bytes], level: float | None = None, walls: Sequence[FloatArray] = ()
) -> dict[str, Any]:
    """What the template of a run's viewer needs; of long runs, it shows at most a thousand frames, evenly spread.

    `images` are JPEG data by frame name: where there are some, the frames shown are among these. `level` is the p-value
    at or below which an image shows no known place. `walls` are (2, 2) segments, drawn where the plan shows x and y.
    """
    answer = read_tum(folder / TRAJECTORY)
    n = len(answer)
    paths = Paths(
        answer,
        _beside(folder / TRUTH, n),
        *(_beside(folder / "methods" / f"{name}.tum", n) for name in ("classical", ONLINE)),
    )
    stride = max(1, -(-n // MOST_FRAMES))
    shown, kinds, held = [], Counter[str](), []
    for i, record in zip(range(n), iter_region_records(folder / REGIONS), strict=False):
        frame = page_frame(i, record, paths)
        kinds[kind_of(frame)] += 1
        if frame["size"] is not None and "held" in frame:
            held.append(frame["held"])
        if frame["n"] in images if images else i % stride == 0:
            shown.append(with_image(frame, images))
    rmse_m = {}
    if paths.truth is not None:
        if paths.online is not None:
            rmse_m["when a frame comes"] = trajectory_errors(paths.online, paths.truth)["rmse_m"]
        rmse_m["as shown here"] = trajectory_errors(paths.answer, paths.truth)["rmse_m"]
    extent = np.ptp(answer.positions_xyz, axis=0)
    flat = sorted(np.argsort(-extent)[:2].tolist())
    data = {
        "frames": shown,
        "axes": flat,
        "up": ({0, 1, 2} - set(flat)).pop(),
        "truth": paths.truth is not None,
        "classical": paths.classical is not None,
        "level": level,
        "walls": [np.round(wall, 3).tolist() for wall in walls] if flat == [0, 1] else [],
    }
    return {
        "json": json_in_script(data),
        "script": _script(),
        "text": describe_run(kinds, len(held), sum(held), rmse_m),
        "note": "" if len(shown) == n else f"{len(shown)} of {counted(n, 'frame')} are shown, evenly spread.",
        "n_shown": len(shown),
        "has_images": bool(images),
        **{name: getattr(paths, name) is not None for name in ("truth", "classical", "online")},
        "known": any(frame.get("kp") is not None for frame in shown),
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


def _beside(path: Path, n: int) -> Trajectory | None:
    if not path.is_file():
        return None
    found = read_tum(path)
    return found if len(found) == n else None
