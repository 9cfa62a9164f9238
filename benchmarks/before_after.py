"""Training seconds, milliseconds an answer and size of the model: this source beside an older one, in turns.

git worktree add /tmp/old 3346ed2
python benchmarks/before_after.py /tmp/old [--repeats 3]

Redkitchen, `interleaved`, features cached. An answer is all that follows the network and the tracker: from features,
local features and relative motions to regions and paths, for all test frames.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from common import DATA, ROOT, write_table

MEASURE = """
import json, sys, tempfile, time
from pathlib import Path
from conformodal.datasets import read_sevenscenes
from conformodal.running import (
    ModelConfig, VisualOdometry, measure_motions, prepare_training_data, save_model, train_model,
)
from conformodal.poses import trajectory_errors
from conformodal.vision import FeatureCache, TrainingConfig, default_cache_dir

seed = int(sys.argv[2])
sequence = read_sevenscenes(Path(sys.argv[1]))
cache = FeatureCache(default_cache_dir())
config = ModelConfig(seed=seed, alpha=0.1, training=TrainingConfig(seed=seed))
data = prepare_training_data(sequence, config, cache)
started = time.perf_counter()
model = train_model(data, config)
trained = time.perf_counter()
with tempfile.TemporaryDirectory() as folder:
    save_model(model, Path(folder))
    size = sum(file.stat().st_size for file in Path(folder).rglob("*") if file.is_file())
frames = model.split.test
motions = measure_motions(sequence, frames)
odometry = VisualOdometry(model)
odometry.process(sequence, frames[:10], cache=cache, motions=motions)
before = time.perf_counter()
run = odometry.process(sequence, frames, cache=cache, motions=motions)
answered = time.perf_counter()
truth = sequence.require_truth()[run.frames]
print(json.dumps({
    "train_s": trained - started, "answer_ms": 1e3 * (answered - before) / len(frames), "model_mb": size / 1e6,
    "rmse_m": trajectory_errors(run.trajectory, truth)["rmse_m"],
}))
"""
ROWS = {"train_s": "training, s", "answer_ms": "an answer, ms", "model_mb": "model files, MB", "rmse_m": "RMSE, m"}


def measured(source: Path, seed: int) -> dict[str, float]:
    environment = {**os.environ, "PYTHONPATH": str(source / "src"), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-c", MEASURE, str(DATA / "7scenes" / "redkitchen" / "seq-01"), str(seed)]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path, help="checkout of the older source")
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    pairs = [(measured(asked.old, 10 + k), measured(ROOT, 10 + k)) for k in range(asked.repeats)]
    rows = []
    for name, label in ROWS.items():
        old, new = (np.array([pair[side][name] for pair in pairs]) for side in (0, 1))
        ratio = new / old
        cells = [f"{np.median(v):.4g} ({v.min():.4g} to {v.max():.4g})" for v in (old, new, ratio)]
        rows.append([label, *cells])
    revision = subprocess.run(
        ["git", "-C", str(asked.old), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    write_table(
        "before_after",
        "This source beside an older one",
        f"python benchmarks/before_after.py OLD --repeats {asked.repeats}",
        ["", f"source {revision}", "this source", "ratio"],
        rows,
        "Redkitchen, `interleaved`, features cached, one thread; seeds 10 and up, one a repeat; both sources in turns. "
        "Medians and ranges.",
    )


if __name__ == "__main__":
    main()
