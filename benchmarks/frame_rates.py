"""Coverage of regions from posteriors on new flights, at other frame rates than that of the calibration.

python benchmarks/frame_rates.py [--seeds 30]

Models are of a corridor of three modules, one lap; flights are new ones through the same world, rendered at 30 frames
per second and thinned. Models, flights and numbers are kept, so an interrupted run goes on.
"""

from __future__ import annotations

import shlex
import sys
from functools import partial
from pathlib import Path

import numpy as np
from common import RUNS, cached_json, mean_interval, parser_with_seeds, part_of, write_table

from conformodal.conformal.coverage import grouped_coverage_band
from conformodal.corridor import write_corridor
from conformodal.corridor.flight import FRAME_RATE_HZ, drone_path, write_flight
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, poses_at
from conformodal.io import Recording, read_recording
from conformodal.localizer.candidates import pose_targets
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model

MODULES, LAPS, ALPHA, NEW_FLIGHT = 3, 1, 0.2, 1000
RATES_HZ = (2, 10, 30)
SPLITS = ("interleaved", "blocks")


def known_flight(seed: int, runs: Path) -> Recording:
    """The flight that a model learns from."""
    folder = runs / f"corridor-{seed}"
    if not folder.is_dir():
        write_corridor(folder, n_modules=MODULES, n_laps=LAPS, seed=seed)
    return read_recording(folder)


def new_flight(seed: int, rate_hz: float, runs: Path) -> Recording:
    """Another flight through the same world; every rate sees the same path."""
    folder, most_hz = runs / f"new-{seed}" / "seq-01", max(RATES_HZ)
    if not folder.is_dir():
        world = CorridorWorld(MODULES, seed=seed)
        path = drone_path(world, LAPS, seed + NEW_FLIGHT)
        times = np.arange(0, path.timestamps_s[-1], 1 / most_hz)
        rows, _ = poses_at(path, times, 2 / FRAME_RATE_HZ)
        poses = Trajectory(times, rows[:, :3], rows[:, 3:]).poses_se3
        write_flight(folder, Renderer(world), poses, noise_seed=(seed + NEW_FLIGHT) * 1_000_003)
        (folder.parent / "frame-rate.txt").write_text(f"{most_hz}\n", encoding="utf-8")
    flight = read_recording(folder.parent)
    return part_of(flight, np.arange(0, len(flight), round(most_hz / rate_hz)))


def estimator(split: str, seed: int, runs: Path) -> VisualOdometry:
    """What answers, trained on the known flight."""
    folder = runs / f"model-{split}-{seed}"
    if not folder.is_dir():
        training = TrainingConfig(epochs=10, seed=seed)
        config = ModelConfig(split=split, alpha=ALPHA, seed=seed, training=training)
        data = prepare_training_data(known_flight(seed, runs), config, FeatureCache(runs / "cache"))
        save_model(train_model(data, config), folder)
    return VisualOdometry(load_model(folder))


def measured(split: str, seed: int, rate_hz: float, runs: Path) -> dict[str, float]:
    """Coverage and size of all regions of a flight, and how often a reliable one misses the pose."""
    odometry, flight = estimator(split, seed, runs), new_flight(seed, rate_hz, runs)
    targets = pose_targets(flight.require_truth(), odometry.model.sign_reference)
    run = odometry.process(flight)
    by_name = {"image": run.regions, **run.path_regions}
    held = {name: regions.contains(targets, joint=True) for name, regions in by_name.items()}
    numbers = {name: float(inside.mean()) for name, inside in held.items()}
    for name, regions in by_name.items():
        lengths = np.where(regions.unbounded.any(axis=1), np.inf, regions.length[:, :3].mean(axis=1))
        numbers[f"{name}_m"] = float(np.median(lengths))
    numbers |= {"units": odometry.model.calibration.n_units, "seconds": int(np.ptp(flight.timestamps_s))}
    missed = ~held.get("online", held["image"])
    return numbers | {"reliable": float(run.reliable.mean()), "missed": float(np.mean(run.reliable & missed))}


def main() -> None:
    parser = parser_with_seeds(__doc__, seeds=(30,))
    options = parser.parse_args()
    rows, columns = [], ("image", "online", "hindsight", "image_m", "online_m", "reliable", "missed")
    for split in SPLITS:
        for rate in RATES_HZ:
            by_seed = [
                cached_json(
                    RUNS / "frame_rates" / f"{split}-{rate}-{seed}.json",
                    partial(measured, split, seed, rate, RUNS / "frame_rates"),
                )
                for seed in options.seeds
            ]
            cells = [mean_interval([one[key] for one in by_seed if key in one], 3) for key in columns]
            band = grouped_coverage_band([(one["units"], one["seconds"]) for one in by_seed], ALPHA, 0.95)
            rows.append([split, str(rate), f"{band[0]:.2f} to {band[1]:.2f}", *cells])
    note = (
        f"Mean and 95 % interval over the flights of seeds {options.seeds}, alpha = {ALPHA}: whole poses in the "
        "image's region, in that from the frames so far, and in hindsight; the median of the mean length of the first "
        "two along an axis; poses called reliable, and those whose region from the frames so far (the image's where "
        "there is none) misses, as shares of all frames. Band: the central 95 % of the coverage, if the flight were "
        "exchangeable with what calibrates, and all frames of a second alike. No guarantee reaches another flight: "
        "coverage here is an observation."
    )
    title = "Coverage at other frame rates"
    header = ["split", "frames per second", "band", *columns]
    write_table("frame_rates", title, shlex.join(["python", *sys.argv]), header, rows, note)


if __name__ == "__main__":
    main()
