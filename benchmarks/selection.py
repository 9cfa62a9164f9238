"""Does the radius around the chosen pose keep its promise in recordings that nobody has seen? In the corridor.

python benchmarks/selection.py [--flights 80]
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
from common import write_table

from conformodal.cli.demo import ALPHA, N_LAPS, N_MODULES, TRAINING
from conformodal.datasets import read_sevenscenes
from conformodal.datasets.corridor import CorridorWorld, Renderer, drone_path, write_corridor, write_flight
from conformodal.odometry import (
    ModelConfig,
    OdometryRun,
    Promise,
    Sizing,
    VisualOdometry,
    depth_or_default,
    fit_pose_radius,
    joint_error,
    prepare_training_data,
    recording_errors,
    recording_sizes,
    train_model,
)
from conformodal.poses import Trajectory
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


def fly(n_flights: int) -> tuple[OdometryRun, Trajectory, npt.NDArray[np.int64], float]:
    """Train on the laps and answer the flights: the run, the truth, recordings' numbers, metres that weigh a radian."""
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch) / "train", n_modules=N_MODULES, n_laps=N_LAPS, seed=0)
        config = ModelConfig(alpha=ALPHA, seed=0, training=replace(TRAINING, seed=0))
        cache = FeatureCache(Path(scratch) / "cache")
        model = train_model(prepare_training_data(read_sevenscenes(Path(scratch) / "train"), config, cache), config)
        write_flights(Path(scratch) / "new", n_flights)
        flights = read_sevenscenes(Path(scratch) / "new")
        run = VisualOdometry(model).process(flights, cache=cache)
    return run, flights.require_truth(), flights.recording, depth_or_default(model.prior.depth_m)


def tabulate(run: OdometryRun, truth: Trajectory, recording: npt.NDArray[np.int64], depth_m: float) -> None:
    """Calibrate on some flights, ask the others, over and over."""
    n_flights = len(np.unique(recording))
    rng = np.random.default_rng(0)
    splits = [rng.permutation(n_flights) for _ in range(SPLITS)]
    rows = []
    for method in ("smoothed", "online", "greedy"):
        errors = recording_errors(run, method, truth, recording)
        scores = [joint_error(*pair, depth_m) for pair in errors]
        for promise, alpha, sizing in product(Promise, ALPHAS, Sizing):
            sizes = np.array(recording_sizes(run, method, recording, sizing, alpha, depth_m))
            kept, worst, metres, degrees = [], [], [], []
            for order in splits:
                known, asked = order[:N_CALIBRATION], order[N_CALIBRATION:]
                radius = fit_pose_radius(
                    [errors[i] for i in known],
                    alpha,
                    promise,
                    method,
                    metres_per_rad=depth_m,
                    sizing=sizing,
                    sizes=sizes[known].tolist(),
                )
                inside = [scores[i] / sizes[i] <= radius.radius_rad for i in asked]
                shares = [x.mean() for x in inside]
                kept.append(np.mean([x.all() for x in inside]) if promise is Promise.RECORDING else np.mean(shares))
                worst.append(min(shares))
                metres.append(radius.radius_m * sizes[asked].mean())
                degrees.append(np.mean([radius.degrees(size) for size in sizes[asked]]))
            size = [
                f"{np.median(v):.2f} ({np.percentile(v, 5):.2f} to {np.percentile(v, 95):.2f})"
                for v in (metres, degrees)
            ]
            shown = [f"{np.mean(kept):.3f}", f"{np.mean(worst):.2f}"]
            rows.append([method, str(promise), f"{1 - alpha:g}", str(sizing), *shown, *size])
    smoothed = np.concatenate([metres for metres, _ in recording_errors(run, "smoothed", truth, recording)])
    notes = (
        f"{n_flights} flights of {FRAMES} frames each through the corridor of the training data, each with gusts of "
        f"its own (median error of `smoothed` {np.median(smoothed):.3f} m); {N_CALIBRATION} calibrate the radius, the "
        f"others are asked, in {SPLITS} random splits. One score for both errors: one radian weighs as much as "
        f"{depth_m:.2f} m, the scene's depth as training found it. Frame: a frame at random; recording: all {FRAMES} "
        "frames. Worst: share of frames kept in the worst flight of a split, mean over splits. Sizes: mean over the "
        "flights asked; median, and 5 to 95 % over splits. Nothing was chosen on these flights. Rooms are 4 m apart "
        "and all alike, so answers are rooms off while their angles are right: one threshold for both gives the angle "
        "as wide a radius as the rooms need."
    )
    header = ["answer", "promise", "asked", "sizing", "kept", "worst", "radius (m)", "radius (degrees)"]
    write_table("selection", "The promise of the chosen pose", "python benchmarks/selection.py", header, rows, notes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=80)
    tabulate(*fly(parser.parse_args().flights))


if __name__ == "__main__":
    main()
