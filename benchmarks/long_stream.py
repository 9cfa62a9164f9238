"""Memory and time per frame of one long stream: both must stay what they are.

python benchmarks/long_stream.py

redkitchen in 160x120 pixels trains a small model; some of its frames then come forwards and backwards as one endless
stream, whose results are written as `run` writes them. The stream has a process of its own. A fixed computation is
timed beside each frame, since hours pass and other work makes the machine faster or slower.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from common import REDKITCHEN, parser_of, write_table

from conformodal.core.arrays import FloatArray
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.io import read_recording
from conformodal.io.streams.frames import Frame
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.results import ResultsWriter
from conformodal.pipeline.store import save_model
from conformodal.pipeline.stream import StreamRunner
from conformodal.pipeline.train import prepare_training_data, train_model

FRAMES, RATE, SHOWN = 200_000, 30, 100  # frames per second; images, which come forwards and backwards
MAPPED, SHRUNK = 400, 4  # frames that the model is trained on, and the factor by which images are smaller
WARM_SHARE, BLOCKS = 0.1, 10  # of the frames, which are not compared; blocks of equal length
WINDOW, OVERLAP = 400, 60  # of whole paths: smaller than those of a run, so that each block has some
SOURCES, N_BINS = ("head", "neighbours", "landmarks"), 16  # per target


def write_small(folder: Path) -> None:
    """The first frames of redkitchen in small images."""
    folder.mkdir(parents=True)
    intrinsics = np.loadtxt(REDKITCHEN.parent / "camera-intrinsics.txt")
    intrinsics[:2] /= SHRUNK
    intrinsics[:2, 2] += 0.5 / SHRUNK - 0.5  # pixel centres are whole numbers
    np.savetxt(folder / "camera-intrinsics.txt", intrinsics)
    for file in sorted(REDKITCHEN.glob("*.color.*"))[:MAPPED]:
        image = cv2.imread(str(file))
        small = cv2.resize(image, None, fx=1 / SHRUNK, fy=1 / SHRUNK, interpolation=cv2.INTER_AREA)
        name = file.name.partition(".")[0]
        cv2.imwrite(str(folder / f"{name}.color.png"), small)
        shutil.copy(file.with_name(f"{name}.pose.txt"), folder)


def train_briefly(folder: Path) -> None:
    """Write a small recording, and a model of it whose training is short."""
    write_small(folder / "small")
    sequence = read_recording(folder / "small")
    config = ModelConfig(sources=SOURCES, features="xfeat", n_bins=N_BINS, training=TrainingConfig(epochs=5))
    save_model(train_model(prepare_training_data(sequence, config, FeatureCache(None)), config), folder / "model")


def fixed_computation() -> FloatArray:
    """Some NumPy and some Python, of half a millisecond."""
    values = np.arange(20_000.0)[::-1] % 1009
    return np.sort(values) + sum(k % 7 for k in range(2_000))


def answer(folder: Path, n_frames: int) -> FloatArray:
    """CPU seconds of each frame, resident MB after it, and CPU seconds of the fixed computation, (n, 3)."""
    sequence, odometry = read_recording(folder / "small"), VisualOdometry.load(folder / "model")
    images = [sequence.image(i) for i in range(SHOWN)]
    order = [*range(SHOWN), *range(SHOWN - 2, 0, -1)]
    measured = np.zeros((n_frames, 3))
    with (
        ResultsWriter(folder / "out") as writer,
        StreamRunner(odometry, writer, window=WINDOW, overlap=OVERLAP) as runner,
        Path("/proc/self/statm").open("rb", buffering=0) as memory,
    ):
        for k in range(n_frames):
            frame = Frame(f"frame-{k:06d}", k / RATE, images[order[k % len(order)]])
            started = time.thread_time()
            runner.push(frame)
            memory.seek(0)
            pages = int(memory.read().split()[1])
            answered = time.thread_time()
            fixed_computation()
            memory_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            measured[k] = answered - started, memory_mb, time.thread_time() - answered
        runner.finish()
    return measured


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of the stream")
    n_frames = parser.parse_args().frames
    with tempfile.TemporaryDirectory() as scratch:
        train_briefly(Path(scratch))
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            measured = process.submit(answer, Path(scratch), n_frames).result()
        written_mb = sum(path.stat().st_size for path in Path(scratch, "out").rglob("*.part")) / 1e6
    n_warm = round(WARM_SHARE * n_frames)
    rows, blocks = [], np.array_split(np.arange(n_warm, n_frames), BLOCKS)
    for block in (np.arange(n_warm), *blocks):
        cpu_s, memory_mb, fixed_s = np.median(measured[block], axis=0)
        times = (f"{1e3 * cpu_s:.2f}", f"{1e3 * fixed_s:.3f}", f"{cpu_s / fixed_s:.1f}")
        rows.append([f"{block[0]:,} to {block[-1]:,}", *times, f"{memory_mb:.0f}", f"{measured[block, 1].max():.0f}"])
    medians = np.array([np.median(measured[block], axis=0) for block in blocks])
    most = np.array([measured[block, 1].max() for block in blocks])
    relative = medians[:, 0] / medians[:, 2]
    slower = 100 * (relative / relative[0] - 1)
    note = (
        f"One stream of {n_frames:,} frames of 160x120 pixels at {RATE} per second, all pose sources. "
        "Memory: resident, after each frame. CPU time is that of the thread that answers; another one works out whole "
        f"paths, of {WINDOW:,} frames at a time (`run`: 2,000). From frame {n_warm:,} on, medians of blocks differ by "
        f"{np.ptp(medians[:, 1]):.0f} MB, and the largest value of the last block from that of the first one by "
        f"{most[-1] - most[0]:+.0f} MB; ratios of the CPU time to that of a fixed computation beside each frame differ "
        f"from that of the first block by {slower.min():+.1f} to {slower.max():+.1f} %. "
        f"Files that were written: {written_mb:.0f} MB."
    )
    given = "" if n_frames == FRAMES else f" --frames {n_frames}"
    times = ["CPU ms per frame, median", "fixed computation, ms", "ratio"]
    header = ["frames", *times, "resident MB, median", "resident MB, most"]
    command = f"python benchmarks/long_stream.py{given}"
    write_table("long_stream", "Memory and time of a long stream", command, header, rows, note)


if __name__ == "__main__":
    main()
