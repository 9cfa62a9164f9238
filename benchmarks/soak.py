"""A stream of many frames: memory, open files and milliseconds a frame must not grow.

python benchmarks/soak.py [--frames 200000]

Ctrl-C ends it; the table then has the frames until there.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from common import write_page

from conformodal.datasets import read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.datasets.streams import Frame
from conformodal.odometry import ResultsWriter, StreamRunner, VisualOdometry, load_model
from conformodal.odometry.streaming import WINDOW
from conformodal.report import Thumbnails

FRAMES, EVERY = 200_000, 5_000
WARM = 4 * WINDOW  # frames before the first reading: windows, thumbnails and the allocator have settled
MATCH_EVERY = 6  # as `run` does at a camera's pace


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
        # trained in another process: the memory measured is that of a program that only runs a model
        train = ["train", Path(scratch) / "known", "--out", Path(scratch) / "model", "--epochs", 25, "--alpha", 0.2]
        start = [sys.executable, "-c", "from conformodal.cli import main; main()"]
        subprocess.run([*start, *map(str, train)], check=True)
        model = load_model(Path(scratch) / "model")
        images = [sequence.image(i) for i in range(len(sequence))]
        there_and_back = [*range(len(images)), *range(len(images) - 2, 0, -1)]  # no jump where the loop closes
        rows, pictures = [], Thumbnails()
        with ResultsWriter(Path(scratch) / "results") as writer:
            runner = StreamRunner(VisualOdometry(model, match_every=MATCH_EVERY), writer)
            started, busy = time.perf_counter(), time.process_time()
            with suppress(KeyboardInterrupt):
                for k in range(n_frames):
                    image = images[there_and_back[k % len(there_and_back)]]
                    runner.push(Frame(f"frame{k}", k / 30, image))
                    pictures.add(f"frame{k}", image)
                    if k >= WARM and (k - WARM) % EVERY == 0:
                        now, used = time.perf_counter(), time.process_time()
                        per_frame = 1e3 / (EVERY if rows else k + 1)
                        rows.append(
                            (k, resident_mb(), open_files(), (now - started) * per_frame, (used - busy) * per_frame)
                        )
                        print(rows[-1], flush=True)
                        started, busy = now, used
            runner.finish()
        answered = runner.n_answered
    _, memory, _, ms, cpu = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    half = len(rows) // 2
    lines = ["| frames | resident memory, MB | open files | ms a frame | CPU ms a frame |", "| --- " * 5 + "|"]
    lines += [f"| {a:.0f} | {m:.1f} | {f:.0f} | {t:.2f} | {c:.2f} |" for a, m, f, t, c in rows]
    drift = np.median(memory[half:]) - np.median(memory[:half])
    note = (
        f"{answered} frames of 160 x 120 pixels answered, a recording of {len(images)} frames played there and back; "
        f"local features matched in every {MATCH_EVERY}th frame. Memory: "
        f"{memory.max() - memory.min():.1f} MB between the largest and the "
        f"smallest reading, {drift:+.1f} MB from the median of the first half to that of the second. Milliseconds a "
        f"frame: median {np.median(ms[1:half]):.2f} in the first half and {np.median(ms[half:]):.2f} in the second; of "
        f"the processor, {np.median(cpu[1:half]):.2f} and {np.median(cpu[half:]):.2f}. Other jobs shared the cores."
    )
    write_page("soak", "Many frames", "python benchmarks/soak.py", [*lines, "", note])


if __name__ == "__main__":
    main()
