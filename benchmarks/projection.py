"""What the projection of features costs and saves: seconds of training, and errors of the tuned regressor.

python benchmarks/projection.py [--seeds 0 1 2] [--cache FOLDER]

What it is worth to ours in errors and sets: row "projection" of benchmarks/results/ablation.md. One core. Nothing else
should run.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import numpy as np
import torch
from common import DATA, REDKITCHEN, half_width, seconds_of, spread, write_table

from conformodal.core.arrays import FloatArray
from conformodal.features.extract import FeatureCache
from conformodal.features.heads import fit_head, soft_cross_entropy
from conformodal.features.settings import TrainingConfig
from conformodal.io import Recording, SplitKind, read_recording, read_sevenscenes
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.train import prepare_training_data, train_model
from experiments.regressors import train_tuned

COMPONENTS = {"with": 256, "without": None}
SIZES = (640, 5000)  # the frames that train on redkitchen, and a large recording
N_FEATURES, BINS = 4608, [50] * 7


def head_seconds(n: int, components: int | None, seed: int) -> float:
    """One training of a head on made-up features, the projection's fit included."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, N_FEATURES)).astype(np.float32)
    y = rng.dirichlet(np.ones(BINS[0]), (n, len(BINS))).reshape(n, -1).astype(np.float32)
    config = TrainingConfig(components=components, seed=seed)
    return seconds_of(lambda: fit_head(x, y, BINS, soft_cross_entropy, config))


def regressor(sequence: Recording, config: ModelConfig, cache: FeatureCache) -> tuple[float, float]:
    """RMSE of the tuned regressor's positions on the test part, and the seconds of its search."""
    data = prepare_training_data(sequence, config, cache)
    found = []
    seconds = seconds_of(lambda: found.append(train_tuned(data, config.training)))
    test = data.split.test
    off: FloatArray = found[0].predict(data.features[test])[:, :3] - data.targets[test, :3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--cache", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[list[str]] = []

    def row(what: str, unit: str, of: dict[str, list[float]], digits: int) -> None:
        logs = np.log(of["without"]) - np.log(of["with"])
        half = half_width(logs.tolist())
        mean, low, high = (f"{np.exp(logs.mean() + side):.2f}" for side in (0.0, -half, half))
        rows.append([what, unit, *(spread(of[k], digits) for k in COMPONENTS), f"{mean} ({low} to {high})"])
        print(rows[-1], flush=True)

    with tempfile.TemporaryDirectory() as scratch:
        cache = FeatureCache(asked.cache or Path(scratch))
        head_seconds(64, 8, 0)  # what is imported and allocated once
        for n in SIZES:
            of = {k: [head_seconds(n, c, seed) for seed in asked.seeds] for k, c in COMPONENTS.items()}
            row(f"one head, {n} frames", "s", of, 1)
        redkitchen = read_sevenscenes(REDKITCHEN)
        cabinet = read_recording(DATA / "tum" / "fr3_cabinet")
        prepare_training_data(redkitchen, ModelConfig(), cache)  # features are cached from here on
        ours: dict[str, list[float]] = {k: [] for k in COMPONENTS}
        for seed in asked.seeds:
            for k, c in COMPONENTS.items():
                config = ModelConfig(seed=seed, training=TrainingConfig(components=c, seed=seed))
                data = prepare_training_data(redkitchen, config, cache)
                ours[k].append(seconds_of(lambda d=data, its=config: train_model(d, its)))
        row("ours, redkitchen, `interleaved`", "s", ours, 1)
        for name, sequence in (("redkitchen", redkitchen), ("TUM cabinet", cabinet)):
            for split in (SplitKind.INTERLEAVED, SplitKind.BLOCKS):
                errors: dict[str, list[float]] = {k: [] for k in COMPONENTS}
                seconds: dict[str, list[float]] = {k: [] for k in COMPONENTS}
                for seed in asked.seeds:
                    for k, c in COMPONENTS.items():
                        config = ModelConfig(split=split, seed=seed, training=TrainingConfig(components=c, seed=seed))
                        rmse, took = regressor(sequence, config, cache)
                        errors[k].append(rmse)
                        seconds[k].append(took)
                row(f"tuned regressor's search, {name}, `{split}`", "s", seconds, 1)
                row(f"tuned regressor's error, {name}, `{split}`", "m", errors, 4)
    header = ["what", "unit", *(f"{k}: median (range)" for k in COMPONENTS), "without over with (95 % interval)"]
    note = (
        f"Seeds {asked.seeds} of split and training; made-up features for one head. Ratios are geometric means over "
        "seeds. With: 256 principal components; the regressor's search also tries 64. Without: all features, "
        "standardised. Features are cached; one core."
    )
    line = f"python benchmarks/projection.py --seeds {' '.join(map(str, asked.seeds))}"
    write_table("projection", "The projection of features", line, header, rows, note)


if __name__ == "__main__":
    main()
