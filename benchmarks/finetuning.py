"""What fine-tuning the network's last blocks is worth, to our answer and to the classical regressor, and what it costs.

python benchmarks/finetuning.py [--seeds 3] [--blocks 3]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import DATA, spread, write_table

from conformodal.datasets import Sequence, SplitKind, read_sevenscenes
from conformodal.experiments import opponents_training, train_classical
from conformodal.odometry import (
    ModelConfig,
    MotionRecord,
    VisualOdometry,
    measure_motions,
    prepare_training_data,
    train_model,
)
from conformodal.poses import trajectory_errors
from conformodal.vision import FeatureCache, FineTuning, TrainingConfig

METHODS = ("smoothed", "softmax_mean", "classical", "classical_smoothed")


def one(
    sequence: Sequence, config: ModelConfig, folder: Path, motions: MotionRecord | None
) -> tuple[dict[str, Any], MotionRecord]:
    """Errors, coverage and seconds of one training; and the motions of its test frames."""
    cache = FeatureCache(folder)
    started = time.perf_counter()
    data = prepare_training_data(sequence, config, cache)
    seconds = time.perf_counter() - started
    model = train_model(data, config)
    classical = train_classical(data, opponents_training(config.training))
    motions = motions or measure_motions(sequence, data.split.test)
    run = VisualOdometry(model).process(sequence, data.split.test, cache=cache, motions=motions)
    recording, truth = sequence.recording[run.frames], sequence.require_truth()[run.frames]
    trajectories = {
        **run.trajectories,
        **classical.trajectories(data.features[run.frames], run, recording, model.prior),
    }
    errors = {name: trajectory_errors(t, truth) for name, t in trajectories.items()}
    return {"errors": errors, "seconds": seconds, "length": float(run.regions.length[:, :3].mean())}, motions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--blocks", type=int, default=3)
    arguments = parser.parse_args()
    seeds = range(arguments.seeds)
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    tuning = {"frozen": None, f"last {arguments.blocks} blocks tuned": FineTuning(blocks=arguments.blocks)}
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as scratch:
        for split in (SplitKind.INTERLEAVED, SplitKind.BLOCKS):
            for seed in seeds:
                motions = None
                for name, settings in tuning.items():
                    config = ModelConfig(split=split, seed=seed, training=TrainingConfig(seed=seed))
                    if settings is not None:
                        config = replace(config, fine_tuning=replace(settings, seed=seed))
                    result, motions = one(sequence, config, Path(scratch) / "features", motions)
                    found[str(split), name].append(result)
                    print(split, seed, name, {m: result["errors"][m]["rmse_m"] for m in METHODS}, flush=True)
    rows = []
    for (split, name), results in found.items():
        for method in METHODS:
            errors = [r["errors"][method] for r in results]
            frozen = [r["errors"][method]["rmse_m"] for r in found[split, "frozen"]]
            rows.append(
                [
                    split,
                    name,
                    method,
                    spread([e["rmse_m"] for e in errors]),
                    spread([f / e["rmse_m"] for f, e in zip(frozen, errors, strict=True)], 2),
                    spread([e["rmse_deg"] for e in errors], 2),
                    spread([r["length"] for r in results], 3) if method == METHODS[0] else "",
                    spread([r["seconds"] for r in results], 0) if method == METHODS[0] else "",
                ]
            )
    header = ["split", "network", "method", "rmse_m", "frozen / this", "rmse_deg", "set length, m", "features, s"]
    note = (
        f"Redkitchen, 64 % of the frames train, 16 % calibrate; median and range over seeds {seeds[0]} to {seeds[-1]}. "
        "Tuned with our labels on the training part; both methods then have the same features. Set length: mean over "
        "x, y, z, joint max, alpha = 0.1. Features, s: fine-tuning and the features of all frames (cached where "
        "frozen, but for the first)."
    )
    write_table("finetuning", "Fine-tuning", "python benchmarks/finetuning.py", header, rows, note)


if __name__ == "__main__":
    main()
