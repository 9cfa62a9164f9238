"""Ablation: errors and regions of the paper's system, of ours, and of ours with one part left out at a time.

python benchmarks/ablation.py [--seeds 10 11 12 13 14] [--places ...] [--runs FOLDER] [--workers 2]

Models are cached in the folder of runs, numbers in benchmarks/results/ablation: what is there is not computed again.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two trainings side by side

import cv2
import numpy as np
import torch
from common import (
    REDKITCHEN,
    RESULTS,
    ROOT,
    SEEDS,
    cached_json,
    filtered_path,
    half_width,
    mean_interval,
    parser_with_seeds,
    table_lines,
    without_limits,
    without_rotations,
    write_page,
)
from joblib import Parallel, delayed

from conformodal.cli.demo import N_LAPS, N_MODULES, TRAINING
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.files import default_cache_dir
from conformodal.corridor import write_corridor
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.io import Recording, SplitKind, read_recording
from conformodal.localizer.candidates import Candidates, pose_targets
from conformodal.localizer.observations import MotionPrior, Observations, PosePath
from conformodal.localizer.smoother import image_hypotheses, smooth
from conformodal.pipeline.config import Calibration, ModelConfig
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model

Numbers = dict[tuple[str, int], dict[str, Any]]  # by place and seed

ALPHA = 0.1
KITCHENS = ("redkitchen, interleaved", "redkitchen, blocks")
PLACES = (*KITCHENS, "corridor")
EVERY = {"1/6 s": 0.0, "1 s": 1.0, "3 s": 3.0}  # a fifth of 30 frames per second: a sixth of a second apart
WITHOUT = {  # models of their own
    "landmarks": {"sources": ("head", "neighbours")},
    "neighbours": {"sources": ("head", "landmarks")},
    "order-aware labels": {"sigma_bins": 0.0},
}
PAPER, OURS = "the paper's system", "ours"


# ---- models


def config_of(place: str, seed: int, name: str = OURS) -> ModelConfig:
    """Settings of a model by its name. Frames calibrate in both splits, but for ``stretches``."""
    training = replace(TRAINING, seed=seed) if place == "corridor" else TrainingConfig(seed=seed)
    split = SplitKind.BLOCKS if place.endswith("blocks") else SplitKind.INTERLEAVED
    shared: dict[str, Any] = {"seed": seed, "split": split, "alpha": ALPHA, "training": training}
    if name == PAPER:
        return ModelConfig.paper(**shared)
    units = Calibration.STRETCHES if name == "stretches" else Calibration.FRAMES
    return replace(ModelConfig(**shared, calibrate_on=units), **WITHOUT.get(name, {}))


class Models:
    """All models of a place and a seed, cached in a folder of `runs`."""

    def __init__(self, place: str, seed: int, runs: Path) -> None:
        self.place, self.seed = place, seed
        self.folder = runs / f"{place.replace(', ', '-')}-{seed}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.cache = FeatureCache(self.folder if place == "corridor" else default_cache_dir())

    @cached_property
    def sequence(self) -> Recording:
        """The recording of the place."""
        if self.place in KITCHENS:
            return read_recording(REDKITCHEN)
        if not (self.folder / "world.done").is_file():
            write_corridor(self.folder / "world", n_modules=N_MODULES, n_laps=N_LAPS, seed=self.seed)
            (self.folder / "world.done").touch()
        return read_recording(self.folder / "world")

    def trained(self, name: str = OURS) -> PoseModel:
        """A model by the name of its settings."""
        folder = self.folder / re.sub(r"[^a-z]+", "-", name)
        if not (folder / "model.json").is_file():
            config = config_of(self.place, self.seed, name)
            save_model(train_model(prepare_training_data(self.sequence, config, self.cache), config), folder)
        return load_model(folder)

    def run(self, model: PoseModel, interval_s: float = 0.0) -> OdometryRun:
        """A model's answers to the frames of the test part that follow each other after an interval or more."""
        frames = spaced(self.sequence.timestamps_s, model.split.test, interval_s)
        return odometry_of(model).process(self.sequence, frames)

    def error(self, run: OdometryRun, path: PosePath | Trajectory) -> list[float]:
        """RMSE in metres and degrees of a path over the frames of a run."""
        poses = Trajectory(run.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)
        errors = trajectory_errors(poses, self.sequence.require_truth()[run.frames])
        return [errors["rmse_m"], errors["rmse_deg"]]


def spaced(times: FloatArray, frames: IntArray, interval_s: float) -> IntArray:
    """Of some frames those that follow each other after an interval or more."""
    chosen = [int(frames[0])]
    for i in frames[1:].tolist():
        if times[i] >= times[chosen[-1]] + interval_s - 1e-6:
            chosen.append(i)
    return np.array(chosen)


# ---- paths


def smoothed(observed: Observations, prior: MotionPrior, *, hindsight: bool = True) -> PosePath:
    """The path of the complete system."""
    return smooth(
        image_hypotheses(filtered_path(observed, prior, hindsight=hindsight), observed, prior), observed, prior
    )


def frame_by_frame(observed: Observations, prior: MotionPrior) -> PosePath:
    """The most probable hypothesis of each image alone, smoothed."""
    best = Candidates.concatenate([each.take(np.array([np.argmax(each.log_mass)])) for each in observed.candidates])
    chosen = PosePath(
        observed.timestamps_s,
        best.positions_xyz,
        best.position_spreads,
        best.orientations_quat_wxyz,
        best.orientation_spreads_rad,
    )
    return smooth(image_hypotheses(chosen, observed, prior), observed, prior)


PARTS: dict[str, Callable[[Observations, MotionPrior], PosePath]] = {  # by what is left out
    "submaps": lambda observed, prior: smoothed(replace(observed, submaps=()), prior),
    "relative rotations and submaps": lambda observed, prior: smoothed(without_rotations(observed), prior),
    "limits on speed and turning": lambda observed, prior: smoothed(observed, without_limits(prior)),
    "motion": lambda observed, prior: smoothed(without_rotations(observed), without_limits(prior)),
    "the filter (each frame's most probable hypothesis)": frame_by_frame,
    "later frames in the filter": lambda observed, prior: smoothed(observed, prior, hindsight=False),
    "the smoother": filtered_path,
}


def observations_of(run: OdometryRun) -> Observations:
    """What reasoning over the frames of a run is given."""
    return run.observations(np.arange(len(run.frames)))


# ---- numbers of a place and a seed


def region_numbers(models: Models, run: OdometryRun, model: PoseModel) -> list[float]:
    """Coverage of the whole pose, and mean length of the position's sets in standard deviations; known places only."""
    targets = pose_targets(models.sequence.require_truth(), model.sign_reference)
    deviations, known_place = targets[model.split.train].std(axis=0), run.localization.known
    held = run.regions.contains(targets[run.frames], joint=True)[known_place]
    return [float(held.mean()), float((run.regions.length / deviations)[known_place, :3].mean())]


def measured(place: str, seed: int, runs: Path) -> dict[str, Any]:
    """All numbers of a place and a seed."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    models = Models(place, seed, runs)
    names = (PAPER, OURS, *WITHOUT)
    numbers: dict[str, Any] = {"source": provenance()["source_revision"], "regions": {}}
    for interval, seconds in EVERY.items():
        errors: dict[str, list[float]] = {}
        for name in names:
            model = models.trained(name)
            run = models.run(model, seconds)
            errors[name] = models.error(
                run, run.trajectory if name == PAPER else smoothed(observations_of(run), model.prior)
            )
            if name == OURS:
                errors |= {
                    part: models.error(run, path(observations_of(run), model.prior)) for part, path in PARTS.items()
                }
            if not seconds:
                numbers["regions"][name] = region_numbers(models, run, model)
        numbers[interval] = {"frames": len(run.frames), "errors": errors}
    return numbers


def cache_numbers(file: Path, place: str, seed: int, runs: Path) -> str:
    """Measure one place with one seed where that is not done."""
    cached_json(file, partial(measured, place, seed, runs))
    return file.stem


# ---- tables


def ratio_cell(values: FloatArray) -> str:
    """Geometric mean of ratios and its 95 % interval."""
    logs = np.log(values)
    mean, half = float(logs.mean()), half_width(logs.tolist())
    return f"{np.exp(mean):.2f}" + (
        "" if np.isnan(half) else f" ({np.exp(mean - half):.2f} to {np.exp(mean + half):.2f})"
    )


def write_tables(numbers: Numbers, places: list[str]) -> None:
    """``benchmarks/results/ablation.md``."""
    columns = [(place, interval) for place in places for interval in EVERY]
    header = [f"{place}, {interval}" for place, interval in columns]

    def over_seeds(column: tuple[str, str], name: str, unit: int) -> FloatArray:
        place, interval = column
        return np.array([each[interval]["errors"][name][unit] for (p, _), each in numbers.items() if p == place])

    def ratios(part: str, unit: int) -> list[str]:
        return [part, *(ratio_cell(over_seeds(c, part, unit) / over_seeds(c, OURS, unit)) for c in columns)]

    def region_cells(name: str) -> list[str]:
        means = [np.mean([each["regions"][name] for (p, _), each in numbers.items() if p == q], axis=0) for q in places]
        return [f"{coverage:.3f}, {length:.3f}" for coverage, length in means]

    frames = [
        ", ".join(map(str, sorted({each[i]["frames"] for (q, _), each in numbers.items() if q == p})))
        for p, i in columns
    ]
    errors = [[name, *(mean_interval(over_seeds(c, name, 0).tolist()) for c in columns)] for name in (PAPER, OURS)]
    seeds, sources = sorted({seed for _, seed in numbers}), sorted({each["source"] for each in numbers.values()})
    parts = [*WITHOUT, *PARTS]
    write_page(
        "ablation",
        "The paper's system, ours, and ours without one part",
        shlex.join(["python", *sys.argv]),
        "Position RMSE in metres, mean over seeds and 95 % interval (Student's t), smoothed path.",
        table_lines(["system", *header], [["test frames", *frames], *errors]),
        "## Ours with one part left out",
        "Position error without the part over the error with it: geometric mean over seeds and 95 % interval.",
        table_lines(["left out", *header], [ratios(part, 0) for part in parts]),
        "The same of orientation errors:",
        table_lines(["left out", *header], [ratios(part, 1) for part in parts]),
        "## Regions",
        "Whole pose covered (guaranteed: 0.9 on `interleaved`, nothing on `blocks`), and mean length of the position's "
        "sets in standard deviations; frames that show a known place; means over seeds.",
        table_lines(["model", *places], [[name, *region_cells(name)] for name in (OURS, *WITHOUT)]),
        f"Seeds {', '.join(map(str, seeds))} of split, training and corridor. Measured with source "
        f"{', '.join(sources)}. Test frames, a fifth of all: all of them (1/6 s), or those that follow each other "
        "after 1 s or 3 s; the tracker always sees the frames between. Frames calibrate in both splits. Errors on "
        "redkitchen are against KinectFusion's poses (two_truths.md).",
    )


def main() -> None:
    parser = parser_with_seeds(__doc__, SEEDS)
    parser.add_argument("--places", nargs="+", default=list(PLACES), choices=PLACES)
    parser.add_argument("--runs", type=Path, default=ROOT / "ablation-out")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    files = {
        (place, seed): RESULTS / "ablation" / f"{place.replace(', ', '-')}-{seed}.json"
        for seed in options.seeds
        for place in options.places
    }
    jobs = (delayed(cache_numbers)(file, *key, options.runs) for key, file in files.items() if not file.is_file())
    for name in Parallel(options.workers, return_as="generator_unordered", batch_size=1)(jobs):
        print(time.strftime("%H:%M:%S"), name, flush=True)
    write_tables({key: json.loads(file.read_text(encoding="utf-8")) for key, file in files.items()}, options.places)


if __name__ == "__main__":
    main()
