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
from conformodal.localizer.filter import PoseFilter  # noqa: E402
from conformodal.localizer.sources import landmarks  # noqa: E402
from conformodal.pipeline import estimator  # noqa: E402
from conformodal.pipeline.estimator import VisualOdometry  # noqa: E402
from conformodal.pipeline.model import PoseModel  # noqa: E402
from conformodal.tracking.frontend import MotionFrontEnd  # noqa: E402

WARM = 10
PARTS = ("network", "tracking and relative pose", "local features", "landmarks", "regions", "filter")


def answer(model: Path, images: list[str]) -> dict[str, Any]:
    """What one stream costs."""
    odometry = VisualOdometry.load(model)
    first, spent, frames = 0.0, defaultdict(float), []
    for k, path in enumerate(images):
        image = read_image(Path(path))
        if k == 1:
            first = time.perf_counter() - BEGAN
        if k == WARM:
            watch(spent)
        started = time.perf_counter()
        odometry.step(image, k / 30)
        if k >= WARM:
            frames.append(1e3 * (time.perf_counter() - started))
    return {
        "median": float(np.median(frames)),
        "p99": float(np.percentile(frames, 99)),
        "mean": float(np.mean(frames)),
        "parts": {name: 1e3 * spent[name] / len(frames) for name in PARTS},
        "first_s": first,
        "resident_mb": peak_mb(),
    }


def peak_mb() -> float:
    """Most memory that was resident; rusage would have the parent's too."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1e3


def watch(spent: dict[str, float]) -> None:
    """Time spent in parts of an estimator, from now on."""
    watched = [
        (Backbone, "features_of", "network"),
        (MotionFrontEnd, "measure", "tracking and relative pose"),
        (estimator, "extract_local_features", "local features"),
        (landmarks.LandmarkSource, "answer", "landmarks"),
        (PoseModel, "image_regions", "regions"),
        (PoseModel, "path_regions", "regions"),
        (PoseFilter, "push", "filter"),
    ]

    def wrap(inner: Callable[..., Any], name: str) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            started = time.perf_counter()
            try:
                return inner(*arguments, **options)
            finally:
                spent[name] += time.perf_counter() - started

        return timed

    for owner, method, name in watched:
        setattr(owner, method, wrap(getattr(owner, method), name))


if __name__ == "__main__":
    model, images = json.load(sys.stdin)
    print(json.dumps(answer(Path(model), images)))
