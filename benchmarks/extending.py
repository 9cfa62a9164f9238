"""Add a recording to a model: seconds, errors and coverage in either place, beside training on both at once.

python benchmarks/extending.py [--seed 10] [--runs FOLDER]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import DATA, REDKITCHEN, RESULTS, cached_json, write_table

from conformodal.core.files import default_cache_dir
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.io import Recording, SplitKind, read_recording
from conformodal.io.joining import join_recordings
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.extending import extend_model
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.tracking.flow import frame_features

PAIRS = ("redkitchen, halves", "fr1_desk, then fr1_xyz")


def pair(name: str) -> tuple[Recording, Recording]:
    """The recording that is mapped first, and the one that is added."""
    if name == PAIRS[1]:
        return read_recording(DATA / "tum" / "fr1_desk"), read_recording(DATA / "tum" / "fr1_xyz")
    whole = read_recording(REDKITCHEN.parent)
    half = len(whole) // 2
    return part_of(whole, slice(half)), part_of(whole, slice(half, None))


def part_of(sequence: Recording, rows: slice) -> Recording:
    """Some frames of a sequence."""
    return replace(
        sequence,
        image_paths=sequence.image_paths[rows],
        timestamps_s=sequence.timestamps_s[rows],
        recording=sequence.recording[rows],
        truth=sequence.require_truth()[rows],
    )


def timed(work: Callable[[], PoseModel]) -> tuple[PoseModel, dict[str, float]]:
    """A model, and the seconds that it took: on the clock, and of all cores together."""
    before, started = os.times(), time.perf_counter()
    model, after = work(), os.times()
    cpu = after.user + after.system - before.user - before.system
    return model, {"wall_s": time.perf_counter() - started, "cpu_s": cpu}


def measured(name: str, seed: int) -> dict[str, dict[str, float]]:
    """Numbers of each model: seconds, and errors and coverage of held-out frames of either recording."""
    first, second = pair(name)
    cache, config = FeatureCache(default_cache_dir()), ModelConfig(split=SplitKind.BLOCKS, seed=seed)
    data = prepare_training_data(first, config, cache)
    both = prepare_training_data(join_recordings([first, second]), config, cache)  # all features are cached then
    model, seconds = timed(lambda: train_model(data, config))
    more, added = timed(lambda: extend_model(model, second, cache))
    both = replace(both, split=more.split)  # which holds out the same frames
    whole, joint = timed(lambda: train_model(both, config))
    test = more.split.test
    held_out = ("first", first, test[test < len(first)]), ("added", second, test[test >= len(first)] - len(first))
    return {
        label: spent
        | {
            f"{place} {k}": v
            for place, sequence, rows in held_out
            for k, v in answered(its, sequence, rows, cache).items()
        }
        for label, its, spent in (
            ("first alone", model, seconds),
            ("extended", more, added),
            ("both at once", whole, joint),
        )
    }


def answered(model: PoseModel, sequence: Recording, frames: np.ndarray, cache: FeatureCache) -> dict[str, float]:
    """Errors of the most probable pose of each image, and coverage and size of its region."""
    features = extract_features([sequence.image_paths[i] for i in frames], model.backbone, cache)
    local = [frame_features(sequence, i) for i in frames.tolist()]
    found = model.localize(FrameEvidence(features, local))
    best = np.array([its.positions_xyz[0] for its in found.candidates])
    truth = sequence.require_truth()
    off = np.linalg.norm(best - truth.positions_xyz[frames], axis=1)
    bounded = ~found.regions.unbounded.any(axis=1)
    held = found.regions.contains(pose_targets(truth, model.sign_reference)[frames], joint=True)
    length = found.regions.length[bounded, :3].mean(axis=1)
    return {
        "rmse_m": float(np.sqrt(np.mean(off**2))),
        "median_m": float(np.median(off)),
        "unbounded": float(1 - bounded.mean()),
        "coverage": float(held[bounded].mean()) if bounded.any() else float("nan"),
        "length_m": float(np.median(length)) if bounded.any() else float("nan"),
    }


def main() -> None:
    """Measure both pairs and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=10)
    parser.add_argument("--runs", type=Path, default=RESULTS / "extending", help="folder of the numbers of each pair")
    args = parser.parse_args()
    rows, keys = [], ("rmse_m", "median_m", "unbounded", "coverage", "length_m")
    for name in PAIRS:
        file = args.runs / f"{name.replace(', ', '-').replace(' ', '-')}-{args.seed}.json"
        for label, its in cached_json(file, lambda name=name: measured(name, args.seed)).items():
            for place in ("first", "added"):
                numbers = [f"{its[f'{place} {key}']:.3f}" for key in keys]
                rows.append([name, label, f"{its['cpu_s']:.0f}", f"{its['wall_s']:.0f}", place, *numbers])
    write_table(
        "extending",
        "A recording that is added to a model",
        f"python benchmarks/extending.py --seed {args.seed}",
        ["recordings", "model", "CPU s", "wall s", "held-out frames of", *keys],
        rows,
        f"Split `blocks`, seed {args.seed}, alpha 0.1, images by themselves, features cached. Seconds are those of the "
        "last step (training, or extending), on a machine with other work: compare CPU seconds. Coverage is that of "
        "bounded regions. All models hold out the same frames. Length is the median over frames of the mean along x, y "
        "and z.",
    )


if __name__ == "__main__":
    main()
