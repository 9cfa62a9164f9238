"""How long training takes where another program keeps one core busy, beside training alone.

python benchmarks/busy_core.py [--repeats 3]

The machine should do nothing else: the other program is started here, and kept to the first core.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from common import DATA, spread, write_page

from conformodal.datasets import read_sevenscenes

# In a process of its own: one training of a head, and nothing else; prints seconds and seconds of all cores.
HEAD = """
import sys, time
import numpy as np, torch
from conformodal.networks import fit_head, soft_cross_entropy
from conformodal.vision import TrainingConfig
threads = int(sys.argv[1])
if threads:
    torch.set_num_threads(threads)
    from conformodal.networks import heads
    from contextlib import nullcontext
    heads._one_thread = nullcontext
rng = np.random.default_rng(0)
x, y = rng.normal(size=(600, 4608)).astype(np.float32), rng.dirichlet(np.ones(50), (600, 7)).reshape(600, 350)
fit_head(x, y, [50] * 7, soft_cross_entropy, TrainingConfig(epochs=2))
started, cpu = time.perf_counter(), time.process_time()
fit_head(x, y, [50] * 7, soft_cross_entropy, TrainingConfig(epochs=60))
print(time.perf_counter() - started, time.process_time() - cpu)
"""
TRAIN = """
import sys, time
from pathlib import Path
from conformodal.datasets import read_sevenscenes
from conformodal.running import ModelConfig, prepare_training_data, train_model
from conformodal.vision import FeatureCache
sequence, cache, config = read_sevenscenes(Path(sys.argv[2])), FeatureCache(Path(sys.argv[3])), ModelConfig()
started, cpu = time.perf_counter(), time.process_time()
train_model(prepare_training_data(sequence, config, cache), config)
print(time.perf_counter() - started, time.process_time() - cpu)
"""


@contextmanager
def busy(core: int) -> Iterator[None]:
    """A program that does nothing but keep a core busy."""
    spin = f"import os\nos.sched_setaffinity(0, [{core}])\nwhile True: pass"
    program = subprocess.Popen([sys.executable, "-c", spin])
    try:
        yield
    finally:
        program.kill()
        program.wait()


def timed(script: str, *arguments: str) -> tuple[float, float]:
    """Seconds, and seconds of all cores, of one training."""
    command = [sys.executable, "-c", script, *arguments]
    wall, cpu = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-2:]
    return float(wall), float(cpu)


def load_before() -> float:
    """Programs that ran or waited in a second without ours, as a mean: what the numbers suffer from."""
    seen = []
    for _ in range(20):
        seen.append(int(Path("/proc/loadavg").read_text(encoding="ascii").split()[3].split("/")[0]) - 1)
        time.sleep(0.05)
    return float(np.mean(seen))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    repeats, core = parser.parse_args().repeats, min(os.sched_getaffinity(0))
    others, kitchen = load_before(), DATA / "7scenes" / "redkitchen" / "seq-01"
    lines = [
        "| what | alone, s | one core busy, s | ratio of medians | seconds of all cores, alone |",
        "| --- | --- | --- | --- | --- |",
    ]
    with tempfile.TemporaryDirectory() as cache:
        read_sevenscenes(kitchen)
        timed(TRAIN, "0", str(kitchen), cache)  # features into the cache
        work = {
            "training of a head, as it is (one thread)": (HEAD, "0"),
            "training of a head, two threads": (HEAD, "2"),
            "`train` on redkitchen, three sources, features cached": (TRAIN, "0", str(kitchen), cache),
        }
        for name, (script, *arguments) in work.items():
            alone, beside, cores = [], [], []
            for _ in range(repeats):  # in turn, so that what disturbs the machine disturbs both
                wall, cpu = timed(script, *arguments)
                alone.append(wall)
                cores.append(cpu)
                with busy(core):
                    beside.append(timed(script, *arguments)[0])
            ratio = np.median(beside) / np.median(alone)
            lines.append(
                f"| {name} | {spread(alone, 1)} | {spread(beside, 1)} | {ratio:.2f} | {np.median(cores):.1f} |"
            )
            print(lines[-1], flush=True)
    lines += [
        "",
        f"Median and range of {repeats} repeats, alone and beside the other program in turn; the other program does "
        f"nothing but keep one core busy. Before the first repeat {others:.1f} other programs were running or waiting "
        "for a core, on the mean: where that is more than 0, alone is not alone. Head: 600 samples of 4608 features, "
        "seven targets of fifty bins, 60 epochs.",
    ]
    write_page("busy_core", "Training beside a busy core", "python benchmarks/busy_core.py", lines)


if __name__ == "__main__":
    main()
