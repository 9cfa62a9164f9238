"""Does the radius around the chosen pose keep its promise in recordings that nobody has seen? In the corridor.

python benchmarks/selection.py [--flights 80]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import spread, write_table

from conformodal.cli.demo import ALPHA, N_LAPS, N_MODULES, TRAINING
from conformodal.datasets import read_sevenscenes
from conformodal.datasets.corridor import CorridorWorld, Renderer, drone_path, write_corridor, write_flight
from conformodal.odometry import (
    ModelConfig,
    Promise,
    VisualOdometry,
    fit_pose_radius,
    prepare_training_data,
    recording_errors,
    train_model,
)
from conformodal.vision import FeatureCache

FRAMES, SPLITS, N_CALIBRATION = 60, 2000, 40
ALPHAS = (0.1, 0.2)


def write_flights(folder: Path, n: int) -> None:
    """Flights of a few seconds through the training world: a random stretch of a lap, with gusts of its own."""
    world = CorridorWorld(N_MODULES, seed=0)
    renderer = Renderer(world)
    rng = np.random.default_rng(1)
    for k in range(n):
        poses = drone_path(world, 1, seed=1000 + k).poses_se3
        start = int(rng.integers(len(poses) - FRAMES))
        write_flight(
            folder / f"seq-{k:03d}", renderer, poses[start : start + FRAMES], noise_seed=(1000 + k) * 1_000_003
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=80)
    n_flights = parser.parse_args().flights
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch) / "train", n_modules=N_MODULES, n_laps=N_LAPS, seed=0)
        config = ModelConfig(alpha=ALPHA, seed=0, training=replace(TRAINING, seed=0))
        cache = FeatureCache(Path(scratch) / "cache")
        model = train_model(prepare_training_data(read_sevenscenes(Path(scratch) / "train"), config, cache), config)
        write_flights(Path(scratch) / "new", n_flights)
        flights = read_sevenscenes(Path(scratch) / "new")
        run = VisualOdometry(model).process(flights, cache=cache)
    truth = flights.require_truth()
    rng = np.random.default_rng(0)
    splits = [rng.permutation(n_flights) for _ in range(SPLITS)]
    rows = []
    for method in ("smoothed", "online", "greedy"):
        errors = recording_errors(run, method, truth, flights.recording)
        for promise in Promise:
            for alpha in ALPHAS:
                kept, metres, degrees = [], [], []
                for order in splits:
                    radius = fit_pose_radius([errors[i] for i in order[:N_CALIBRATION]], alpha, promise, method)
                    inside = [
                        (errors[i][0] <= radius.radius_m) & (errors[i][1] <= radius.radius_rad)
                        for i in order[N_CALIBRATION:]
                    ]
                    kept.append(np.mean([x.all() if promise is Promise.RECORDING else x.mean() for x in inside]))
                    metres.append(radius.radius_m)
                    degrees.append(np.degrees(radius.radius_rad))
                size = [
                    f"{np.median(v):.2f} ({np.percentile(v, 5):.2f} to {np.percentile(v, 95):.2f})"
                    for v in (metres, degrees)
                ]
                rows.append([method, str(promise), f"{1 - alpha:g}", f"{np.mean(kept):.3f}", *size])
    medians = spread(
        [
            float(np.median(np.concatenate([e[0] for e in recording_errors(run, m, truth, flights.recording)])))
            for m in ("smoothed",)
        ],
        3,
    )
    notes = (
        f"{n_flights} flights of {FRAMES} frames each through the corridor of the training data, each with gusts of "
        f"its own (median error of `smoothed` {medians} m); {N_CALIBRATION} calibrate the radius, the others are "
        f"asked, in {SPLITS} random splits. Sizes: median, and 5 to 95 % over splits. Half of alpha goes to the "
        "position, half to the orientation, so more is kept than was promised. Frame: a frame at random; recording: "
        f"all {FRAMES} frames."
    )
    header = ["answer", "promise", "asked", "kept", "radius (m)", "radius (degrees)"]
    write_table("selection", "The promise of the chosen pose", "python benchmarks/selection.py", header, rows, notes)


if __name__ == "__main__":
    main()
