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
from conformodal.datasets.corridor.writer import write_corridor
from conformodal.datasets.streams.frames import Frame
from conformodal.model.store import load_model
from conformodal.report.thumbnails import Thumbnails
from conformodal.running.estimator import VisualOdometry
from conformodal.running.results.writer import ResultsWriter
from conformodal.running.streaming import WINDOW, StreamRunner

FRAMES, EVERY, READ_EVERY = 200_000, 10_000, 100
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
    parser.add_argument("--work", type=Path, help="folder to keep the model in, and to take one from that is there")
    asked = parser.parse_args()
    n_frames = asked.frames
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background would not hear of it
    with tempfile.TemporaryDirectory() as scratch:
        work = asked.work or Path(scratch)
        known = work / "known"
        sequence = read_sevenscenes(known if known.exists() else write_corridor(known, n_modules=3, n_laps=1, seed=3))
        if not (work / "model").exists():
            # trained in another process: the memory measured is that of a program that only runs a model
            train = ["train", known, "--out", work / "model", "--epochs", 25, "--alpha", 0.2]
            start = [sys.executable, "-c", "from conformodal.cli import main; main()"]
            subprocess.run([*start, *map(str, train)], check=True)
        model = load_model(work / "model")
        images = [sequence.image(i) for i in range(len(sequence))]
        there_and_back = [*range(len(images)), *range(len(images) - 2, 0, -1)]  # no jump where the loop closes
        rows, memory_now, pictures = [], [], Thumbnails()
        with ResultsWriter(Path(scratch) / "results") as writer:
            runner = StreamRunner(VisualOdometry(model, match_every=MATCH_EVERY), writer)
            started, busy = time.perf_counter(), time.process_time()
            with suppress(KeyboardInterrupt):
                for k in range(n_frames):
                    image = images[there_and_back[k % len(there_and_back)]]
                    runner.push(Frame(f"frame{k}", k / 30, image))
                    pictures.add(f"frame{k}", image)
                    if k % READ_EVERY == 0:
                        memory_now.append(resident_mb())
                    if k >= WARM and (k - WARM) % EVERY == 0:
                        now, used = time.perf_counter(), time.process_time()
                        per_frame = 1e3 / (EVERY if rows else k + 1)
                        rows.append(
                            (
                                k,
                                float(np.median(memory_now)),
                                max(memory_now),
                                open_files(),
                                (now - started) * per_frame,
                                (used - busy) * per_frame,
                            )
                        )
                        print(rows[-1], flush=True)
                        started, busy, memory_now = now, used, []
            runner.finish()
        answered = runner.n_answered
    _, memory, most, _, ms, cpu = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    half = len(rows) // 2
    lines = ["| frames | resident MB, median | most | open files | ms a frame | CPU ms |", "| --- " * 6 + "|"]
    lines += [f"| {a:.0f} | {m:.1f} | {x:.1f} | {f:.0f} | {t:.2f} | {c:.2f} |" for a, m, x, f, t, c in rows]
    medians = np.median(memory[1:half]), np.median(memory[half:])
    note = (
        f"{answered} frames of 160 x 120 pixels answered, a recording of {len(images)} frames played there and back; "
        f"local features matched in every {MATCH_EVERY}th frame. Memory is read every {READ_EVERY} frames; while a "
        f"window of {WINDOW} frames is answered in a thread, it is larger for a moment. Between the rows' medians "
        f"there are {np.ptp(memory[1:]):.1f} MB after the first row, between their median of the first half and that "
        f"of the second {medians[1] - medians[0]:+.1f} MB; the most ever read is {most.max():.1f} MB. Median ms "
        f"a frame in the first half and the second: {np.median(ms[1:half]):.2f} and {np.median(ms[half:]):.2f}, of the "
        f"processor {np.median(cpu[1:half]):.2f} and {np.median(cpu[half:]):.2f}. Other jobs shared the cores."
    )
    write_page("soak", "Many frames", "python benchmarks/soak.py", [*lines, "", note])


if __name__ == "__main__":
    main()
