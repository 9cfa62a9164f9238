"""Held-out frames of redkitchen whose picture is in the training or calibration part too: errors with and without.

python benchmarks/repeated.py [--seeds 10 11 12 13 14]
"""

from __future__ import annotations

import argparse

import numpy as np
from common import REDKITCHEN, SEEDS, mean_interval, write_table

from conformodal.core.files import default_cache_dir
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import position_errors_m
from conformodal.io import read_sevenscenes
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.train import prepare_training_data, train_model

PARTS = ("all held-out frames", "with a picture of their own", "with the picture of a known frame")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    seeds, cache = parser.parse_args().seeds, FeatureCache(default_cache_dir())
    sequence = read_sevenscenes(REDKITCHEN)
    found: dict[str, list[tuple[int, float, float]]] = {part: [] for part in PARTS}
    for seed in seeds:
        config = ModelConfig(seed=seed, training=TrainingConfig(seed=seed))
        model = train_model(prepare_training_data(sequence, config, cache), config)
        test, known = model.split.test, np.concatenate((model.split.train, model.split.calibration))
        repeated = model.known_frames.take(known).known(model.known_frames.take(test))
        run = VisualOdometry(model).process(sequence, test, cache=cache)
        truth = sequence.require_truth()[test]
        errors = position_errors_m(run.trajectory, truth)
        held = run.regions.contains(pose_targets(truth, model.sign_reference), joint=True)
        for part, chosen in zip(PARTS, (np.ones(len(test), dtype=bool), ~repeated, repeated), strict=True):
            rmse = float(np.sqrt(np.mean(errors[chosen] ** 2)))
            found[part].append((int(chosen.sum()), rmse, float(held[chosen].mean())))
        print(seed, *(found[part][-1] for part in PARTS), flush=True)
    rows = [
        [
            part,
            mean_interval([n for n, _, _ in numbers], 1),
            mean_interval([rmse for _, rmse, _ in numbers]),
            mean_interval([held for _, _, held in numbers], 3),
        ]
        for part, numbers in found.items()
    ]
    pictures = len({row.tobytes() for row in model.known_frames.pixels})
    write_table(
        "repeated",
        "Pictures that are there twice",
        f"python benchmarks/repeated.py --seeds {' '.join(map(str, seeds))}",
        ["frames", "number", "rmse_m, smoothed", "whole pose covered"],
        rows,
        f"7-Scenes redkitchen, sequence 01: {len(sequence)} frames with {pictures} different pictures, to the pixel; "
        "repeated pictures have different poses. Split `interleaved`, alpha = 0.1. Mean over seeds "
        f"{', '.join(map(str, seeds))} and 95 % interval (Student's t). Calibration and test frames repeat pictures of "
        "the training part alike, so that the coverage guarantee for frames of this recording holds; it is not one "
        "for new pictures alone.",
    )


if __name__ == "__main__":
    main()
