"""A stream of many frames: memory, open files and milliseconds a frame must not grow.

python benchmarks/soak.py [--frames 200000]

Ctrl-C ends it; the table then has the frames until there.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from common import write_page

from conformodal.datasets import read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.datasets.streams import Frame
from conformodal.odometry import (
    ModelConfig,
    ResultsWriter,
    StreamRunner,
    VisualOdometry,
    prepare_training_data,
    train_model,
)
from conformodal.odometry.streaming import WINDOW
from conformodal.report import Thumbnails
from conformodal.vision import FeatureCache, TrainingConfig

FRAMES, EVERY = 200_000, 5_000
WARM = 4 * WINDOW  # frames before the first reading: windows, thumbnails and the allocator have settled
MATCH_EVERY = 10


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES)
    n_frames = parser.parse_args().frames
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background would not hear of it
    with tempfile.TemporaryDirectory() as scratch:
        sequence = read_sevenscenes(write_corridor(Path(scratch) / "known", n_modules=3, n_laps=1, seed=3))
        config = ModelConfig(alpha=0.2, training=TrainingConfig(epochs=25))
        model = train_model(prepare_training_data(sequence, config, FeatureCache(None)), config)
        images = [sequence.image(i) for i in range(len(sequence))]
        there_and_back = [*range(len(images)), *range(len(images) - 2, 0, -1)]  # no jump where the loop closes
        rows, pictures = [], Thumbnails()
        with ResultsWriter(Path(scratch) / "results") as writer:
            runner = StreamRunner(VisualOdometry(model, match_every=MATCH_EVERY), writer)
            started = time.perf_counter()
            with suppress(KeyboardInterrupt):
                for k in range(n_frames):
                    image = images[there_and_back[k % len(there_and_back)]]
                    runner.push(Frame(f"frame{k}", k / 30, image))
                    pictures.add(f"frame{k}", image)
                    if k >= WARM and (k - WARM) % EVERY == 0:
                        now = time.perf_counter()
                        rows.append(
                            (k, resident_mb(), open_files(), 1e3 * (now - started) / (EVERY if rows else k + 1))
                        )
                        print(rows[-1], flush=True)
                        started = now
            runner.finish()
        answered = runner.n_answered
    at, memory, files, ms = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    half = len(rows) // 2
    lines = ["| frames | resident memory, MB | open files | ms a frame |", "| --- | --- | --- | --- |"]
    lines += [f"| {a:.0f} | {m:.1f} | {f:.0f} | {t:.2f} |" for a, m, f, t in zip(at, memory, files, ms, strict=True)]
    drift = np.median(memory[half:]) - np.median(memory[:half])
    note = (
        f"{answered} frames of 160 x 120 pixels answered, a recording of {len(images)} frames played there and back; "
        f"landmarks in every {MATCH_EVERY}th. Memory: {memory.max() - memory.min():.1f} MB between the largest and the "
        f"smallest reading, {drift:+.1f} MB from the median of the first half to that of the second. Milliseconds: "
        f"median {np.median(ms[1:half]):.2f} in the first half, {np.median(ms[half:]):.2f} in the second."
    )
    write_page("soak", "Many frames", "python benchmarks/soak.py", [*lines, "", note])


if __name__ == "__main__":
    main()
