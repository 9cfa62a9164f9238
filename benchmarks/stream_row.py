"""One stream in a process of its own, for benchmarks/streaming.py: it imports what running a model needs, no more."""

from __future__ import annotations

import time

BEGAN = time.perf_counter()

import json  # noqa: E402
import sys  # noqa: E402
from collections import defaultdict  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

from conformodal.features.backbone import Backbone  # noqa: E402
from conformodal.io import read_image  # noqa: E402
from conformodal.localizer import carrying  # noqa: E402
from conformodal.localizer.filter import PoseFilter  # noqa: E402
from conformodal.localizer.sources.landmarks import LandmarkSource  # noqa: E402
from conformodal.localizer.sources.neighbours import NeighbourSource  # noqa: E402
from conformodal.pipeline.estimator import VisualOdometry  # noqa: E402
from conformodal.pipeline.model import PoseModel  # noqa: E402
from conformodal.tracking.tracker import MotionFrontEnd  # noqa: E402

WARM = 10
PARTS = ("network", "tracking and relative pose", "local features", "carried corners", "landmarks", "neighbours")
PARTS += ("regions", "filter")


def answer(model: Path, images: list[str]) -> dict[str, Any]:
    """What one stream costs."""
    odometry = VisualOdometry.load(model)
    first_s, seconds, calls, frames_ms = 0.0, defaultdict(float), defaultdict(int), []
    for k, path in enumerate(images):
        image = read_image(Path(path))
        if k == 1:
            first_s = time.perf_counter() - BEGAN
        if k == WARM:
            time_parts(seconds, calls)
        started = time.perf_counter()
        odometry.step(image, k / 30)
        if k >= WARM:
            frames_ms.append(1e3 * (time.perf_counter() - started))
    return {
        "median": float(np.median(frames_ms)),
        "p99": float(np.percentile(frames_ms, 99)),
        "mean": float(np.mean(frames_ms)),
        "parts": {name: 1e3 * seconds[name] / len(frames_ms) for name in PARTS},
        "network": calls["network"] / len(frames_ms),
        "first_s": first_s,
        "resident_mb": peak_mb(),
    }


def peak_mb() -> float:
    """Most memory that was resident; rusage would have the parent's too."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1e3


def time_parts(seconds: dict[str, float], calls: dict[str, int]) -> None:
    """Add the time that parts of an estimator take from now on to `seconds`, and count their calls, by their names."""
    timed_calls = [
        (Backbone, "features_of", "network"),
        (MotionFrontEnd, "measure", "tracking and relative pose"),
        (carrying._Detection, "advance", "local features"),
        (carrying._Detection, "finish", "local features"),
        (LandmarkSource, "localize", "landmarks"),
        (LandmarkSource, "carry", "landmarks"),
        (carrying, "follow_corners", "carried corners"),
        (NeighbourSource, "answer", "neighbours"),
        (PoseModel, "image_regions", "regions"),
        (PoseModel, "path_regions", "regions"),
        (PoseFilter, "push", "filter"),
    ]

    def timed(call: Callable[..., Any], name: str) -> Callable[..., Any]:
        def wrapper(*arguments: Any, **options: Any) -> Any:
            started = time.perf_counter()
            try:
                return call(*arguments, **options)
            finally:
                seconds[name] += time.perf_counter() - started
                calls[name] += 1

        return wrapper

    for owner, method, name in timed_calls:
        setattr(owner, method, timed(getattr(owner, method), name))


if __name__ == "__main__":
    model, images = json.load(sys.stdin)
    print(json.dumps(answer(Path(model), images)))
