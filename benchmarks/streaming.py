"""Frames per second of the whole chain, where the time goes, and memory: redkitchen as `conformodal run` sees it.

python benchmarks/streaming.py
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, spread, write_page

from conformodal.cli.run import MATCH_EVERY_LIVE
from conformodal.datasets import read_image, read_sevenscenes
from conformodal.datasets.streams import Frame, SequenceStream, prefetch
from conformodal.motion import MotionFrontEnd
from conformodal.networks import TorchBackbone
from conformodal.odometry import (
    ModelConfig,
    PoseModel,
    ResultsWriter,
    StreamRunner,
    VisualOdometry,
    prepare_training_data,
    train_model,
)
from conformodal.reasoning import OnlineReasoner
from conformodal.report import Thumbnails
from conformodal.vision import Backbone, BackboneConfig, FeatureCache, TrainingConfig, default_cache_dir

REPEATS = 3
ROUNDS = 5  # of the video, for memory


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def stopwatches(spent: dict[str, float], watched: list[tuple[type, str, str]]) -> Iterator[None]:
    """Time spent in methods, by label."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in watched]

    def wrap(inner: Callable[..., Any], label: str) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            started = time.perf_counter()
            try:
                return inner(*arguments, **options)
            finally:
                spent[label] += time.perf_counter() - started

        return timed

    for owner, name, label in watched:
        setattr(owner, name, wrap(getattr(owner, name), label))
    try:
        yield
    finally:
        for owner, name, inner in before:
            setattr(owner, name, inner)


class Again:
    """The same video over and over, as one long recording."""

    live, camera = False, None

    def __init__(self, stream: SequenceStream, rounds: int) -> None:
        self.stream, self.rounds, self.name = stream, rounds, stream.name
        self.n_frames = rounds * stream.n_frames

    def __iter__(self) -> Iterator[Frame]:
        for k in range(self.rounds):
            for f in self.stream:
                yield Frame(f"{k}-{f.name}", f.timestamp_s + 1000 * k, f.image)


def run(
    model: PoseModel,
    stream: Any,
    folder: Path,
    sample: Callable[[], None] | None = None,
    match_every: int = MATCH_EVERY_LIVE,
) -> tuple[int, float]:
    pictures, done = Thumbnails(), 0
    started = time.perf_counter()
    with ResultsWriter(folder) as writer:
        runner = StreamRunner(VisualOdometry(model, match_every=match_every), writer)
        for frame in prefetch(stream):
            runner.push(frame)
            pictures.add(frame.name, frame.image)
            done += 1
            if sample is not None and done % 100 == 0:
                sample()
        answered = time.perf_counter() - started
        runner.finish()
    return done, answered


def _every(frames: int) -> str:
    return "every frame" if frames == 1 else f"every {frames} frames"


def quick_model(sequence: Any) -> PoseModel:
    """A model whose network can be given images of any size; how well it was trained does not change how fast it is."""
    config = ModelConfig(training=TrainingConfig(epochs=5))
    data = prepare_training_data(sequence, config, FeatureCache(default_cache_dir()))
    return train_model(data, config)


def main() -> None:
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    stream = SequenceStream(sequence)
    watched = [
        (Backbone, "prepare", "resizing"),
        (Backbone, "describe", "network"),
        (MotionFrontEnd, "measure", "tracking and relative pose"),
        (OnlineReasoner, "push", "fixed-lag search"),
        (VisualOdometry, "_local_features", "local features"),
        (StreamRunner, "_take", "writing"),
        (Thumbnails, "add", "thumbnails"),
        (VisualOdometry, "step", "step"),
    ]
    lines = [
        "| network input | local features | frames per second | ms a frame, by part |",
        "| --- | --- | --- | --- |",
    ]
    model = quick_model(sequence)
    with tempfile.TemporaryDirectory() as folder:
        for (width, height), match_every in product(((224, 224), (320, 240)), (1, MATCH_EVERY_LIVE)):
            model.backbone = TorchBackbone(BackboneConfig(width=width, height=height))
            run(model, SequenceStream(sequence, np.arange(50)), Path(folder))  # warm
            rates, parts = [], defaultdict(list)
            for _ in range(REPEATS):
                spent: dict[str, float] = defaultdict(float)
                with stopwatches(spent, watched):
                    done, seconds = run(model, stream, Path(folder), match_every=match_every)
                rates.append(done / seconds)
                inside = ("resizing", "network", "tracking and relative pose", "fixed-lag search", "local features")
                spent["belief, region"] = spent.pop("step") - sum(spent[k] for k in inside)
                spent["waiting for images, the rest"] = seconds - sum(spent.values())
                for label, value in spent.items():
                    parts[label].append(1e3 * value / done)
            shown = ", ".join(f"{label} {np.median(values):.1f}" for label, values in parts.items())
            lines.append(f"| {width}x{height} | {_every(match_every)} | {spread(rates, 1)} | {shown} |")
        loaded = resident_mb()
        peak = [loaded]
        run(model, Again(stream, ROUNDS), Path(folder), lambda: peak.append(resident_mb()))
        after_first = max(peak[: len(sequence) // 100])
    rates = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        with ThreadPoolExecutor(max_workers=2) as pool:
            list(pool.map(lambda path: model.backbone.prepare(read_image(path)), sequence.image_paths))
        rates.append(len(sequence) / (time.perf_counter() - started))
    lines += [
        "",
        f"Median and range of {REPEATS} runs over the {len(sequence)} frames of seq-01 (640x480, JPEG), "
        "EfficientNet-Lite0 to block 7, three finders and the calibrated head, from files on disk; until the last "
        "frame is answered. Images are decoded in a thread of its own. Landmarks: how often they are looked for; every "
        f"{MATCH_EVERY_LIVE} frames is the default at a camera's pace.",
        "",
        f"Memory above what the runs before left, model included: {after_first - loaded:.0f} MB at most in the first "
        f"{len(sequence)} frames, {max(peak) - loaded:.0f} MB in {ROUNDS * len(sequence)}.",
        "",
        f"Decoding and resizing alone, two threads: {spread(rates, 0)} frames a second.",
    ]
    write_page("streaming", "A stream of 640x480 frames", "python benchmarks/streaming.py", lines)


if __name__ == "__main__":
    main()
