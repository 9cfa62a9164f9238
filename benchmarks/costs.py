"""What commands cost on this machine: seconds, CPU seconds and memory of training, the demo, and tables.

python benchmarks/costs.py

Each command is a process of its own with an empty cache, and takes the cores that it wants.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from common import DATA, REDKITCHEN, RUNS, cached_json, write_table

HOUSES, ROWS = DATA / "tables_raw" / "house_sales.csv", (100_000, 1_000_000)
FOLDER = RUNS / "costs"
# the command line, with the peak of this process's memory in a last line; what wait4 tells is at least its parent's
MEASURED = (
    "import atexit, runpy, sys; from pathlib import Path; atexit.register(lambda: print("
    "Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0], file=sys.stderr)); "
    "runpy.run_module('conformodal', run_name='__main__')"
)
TRAIN = f"train {REDKITCHEN} --split"
COMMANDS = {
    "train, interleaved": f"{TRAIN} interleaved",
    "train, blocks": f"{TRAIN} blocks",
    "train, blocks, 2 workers": f"{TRAIN} blocks --workers 2",
    "train, blocks, 2 workers on Ray": f"{TRAIN} blocks --workers 2 --engine ray --address local",
    "train, blocks, fr1_desk and fr1_xyz": f"train {DATA}/tum/fr1_desk {DATA}/tum/fr1_xyz --split blocks",
    "demo": "demo",
    "table fit": f"table fit {HOUSES} --target price --model {FOLDER}/prices.cm",
    **{f"table predict, {n:,} rows": f"table predict {FOLDER}/prices.cm {FOLDER}/{n}.parquet" for n in ROWS},
}


def folder_of(name: str) -> Path:
    """Where a command writes."""
    return FOLDER / name.replace(" ", "-").replace(",", "")


def cost(name: str, words: str) -> dict[str, Any]:
    """Seconds, CPU seconds, with those of its workers, and the peak memory of a command."""
    out = folder_of(name)
    command = [sys.executable, "-c", MEASURED, *words.split()]
    if words.startswith("train"):
        command += ["--cache", f"{out}-cache"]
    if not words.startswith("table fit"):
        command += ["--out", f"{out}.parquet" if words.startswith("table") else str(out)]
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    peak_mb = int(finished.stderr.splitlines()[-1]) / 1e3
    return {"s": time.perf_counter() - began, "cpu_s": cpu_s, "peak_mb": peak_mb}


def main() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    houses, rng, rows = pd.read_csv(HOUSES), np.random.default_rng(0), []
    for n in ROWS:
        houses.iloc[rng.integers(len(houses), size=n)].to_parquet(FOLDER / f"{n}.parquet")
    for name, words in COMMANDS.items():
        one = cached_json(FOLDER / f"{name}.json", partial(cost, name, words))
        rows.append([name, *(f"{one[key]:.0f}" for key in ("s", "cpu_s", "peak_mb"))])
        print(rows[-1], flush=True)
    weights = [*FOLDER.glob("train-blocks*/weights-*")]
    alike = {path.name for path in weights if "fr1" not in path.parent.name}  # names hold digests
    note = (
        "redkitchen has 1,000 frames, fr1_desk and fr1_xyz together 706 larger ones; seed 0, defaults, one run each. "
        "Peak: of the main process. The CPU of a Ray cluster's processes is not counted. Tables: 21,613 house "
        "sales, and rows drawn from them. "
        f"Different models of the three trainings on blocks of redkitchen: {len(alike)}."
    )
    header = ["command", "s", "CPU s", "peak, MB"]
    write_table("costs", "What commands cost", "python benchmarks/costs.py", header, rows, note)


if __name__ == "__main__":
    main()
