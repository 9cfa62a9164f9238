"""Whether errors are where a recording is called sparsely covered, which poses and known frames alone decide.

python benchmarks/recording_quality.py [--seeds 10 11 12] [--chosen-on 0 1 2] [--runs FOLDER]

redkitchen, ``blocks``, regions calibrated on frames (one fit instead of six). The frames of a seed are cached in the
folder of runs and not measured again.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import REDKITCHEN, ROOT, cached_json, table_lines, write_page

from conformodal.core.files import default_cache_dir
from conformodal.features.extract import FeatureCache
from conformodal.geometry import position_errors_m
from conformodal.io import SplitKind, read_sevenscenes
from conformodal.localizer.radius import depth_or_default
from conformodal.localizer.sources.source_data import SourceData
from conformodal.pipeline.config import Calibration, ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.pipeline.training_data import TrainingData
from conformodal.quality.place_ambiguity import most_probable
from conformodal.quality.settings import QUALITY
from conformodal.quality.view_coverage import ViewScale, pose_coverage

LARGE_M = 0.1
PATH, ALONE = "the path", "one frame alone"
SHARED: list[SourceData] = []
LIMITS = (0.05, 0.075, 0.1, 0.125, 0.15, 0.2)


def measured(seed: int, cache: Path) -> dict[str, Any]:
    """Of each frame of the test part: what poses say of it, and then the errors of its answers."""
    sequence = read_sevenscenes(REDKITCHEN)
    config = ModelConfig(split=SplitKind.BLOCKS, calibrate_on=Calibration.FRAMES, seed=seed)
    data = prepare_training_data(sequence, config, FeatureCache(cache))
    share(data)
    model = train_model(data, config)
    truth, test = sequence.require_truth(), model.split.test
    scale = ViewScale.of(sequence.camera, depth_or_default(model.prior.depth_m))
    coverage = pose_coverage(truth, sequence.recording, truth[model.localizer.frames], scale)
    run = VisualOdometry(model).process(sequence, test, cache=FeatureCache(cache))
    off = most_probable(run.localization) - truth.positions_xyz[test]
    errors = {
        PATH: position_errors_m(run.trajectory, truth[test]).tolist(),
        ALONE: np.linalg.norm(off, axis=1).tolist(),
    }
    return {
        "source": provenance()["source_revision"],
        "depth_m": scale.depth_m,
        "frame": test.tolist(),
        "change": coverage.change[test].tolist(),
        "errors_m": errors,
    }


def share(data: TrainingData) -> None:
    """Local features and their matches do not depend on the split: they are worked out once for all seeds."""
    if SHARED:
        shared = replace(data._shared, matcher=SHARED[0].matcher, _local_features=SHARED[0]._local_features)
        object.__setattr__(data, "_shared", shared)
    SHARED[:] = [data._shared]


def cached(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """The numbers of a seed, measured once."""
    file = options.runs / f"redkitchen-{seed}.json"
    found: dict[str, Any] = cached_json(file, lambda: measured(seed, options.cache))
    return found


def rows(name: str, results: list[dict[str, Any]], limit: float) -> list[list[str]]:
    """Errors where the nearest known view differs by more than the limit, and elsewhere: one row per kind of error."""
    change = np.concatenate([result["change"] for result in results])
    found = []
    for kind in results[0]["errors_m"]:
        off, cells = np.concatenate([result["errors_m"][kind] for result in results]), [name, kind]
        for part in (change > limit, change <= limit):
            cells.append(str(int(part.sum())))
            large = 100 * np.mean(off[part] > LARGE_M) if part.any() else 0
            cells += [f"{np.median(off[part]):.3f}", f"{large:.0f}"] if part.any() else ["", ""]
        found.append(cells)
    return found


def chosen_by(row: list[str], results: list[dict[str, Any]], limit: float) -> list[str]:
    """The row of a limit, with what it was chosen by."""
    change = np.concatenate([result["change"] for result in results])
    large = np.concatenate([result["errors_m"][row[1]] for result in results]) > LARGE_M
    if not large.any():
        return [*row, ""]
    return [*row, f"{np.mean(change[large] > limit) - np.mean(change[~large] > limit):.2f}"]


def table(first: str, content: list[list[str]], *more: str) -> list[str]:
    what = ("frames", "median, m", f"% over {LARGE_M:g} m")
    return table_lines(
        [first, "errors of", *(f"{part}: {name}" for part in ("sparse", "others") for name in what), *more], content
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12])
    parser.add_argument("--chosen-on", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=ROOT / "quality-out")
    parser.add_argument("--cache", type=Path, default=default_cache_dir())
    options = parser.parse_args()
    chosen = [cached(seed, options) for seed in options.chosen_on]
    reported = [cached(seed, options) for seed in options.seeds]
    each = [
        row for seed, one in zip(options.seeds, reported, strict=True) for row in rows(str(seed), [one], QUALITY.sparse)
    ]
    by_limit = [chosen_by(row, chosen, limit) for limit in LIMITS for row in rows(f"{limit:g}", chosen, limit)]
    depths = [one["depth_m"] for one in chosen + reported]
    write_page(
        "recording_quality",
        "Errors where a recording is called sparsely covered",
        "python benchmarks/recording_quality.py",
        f"redkitchen sequence 01, `blocks`, regions calibrated on frames; models are whole. Frames of the "
        f"test part. One is called sparsely covered if the nearest view that the model knows differs by more than "
        f"{QUALITY.sparse:g} of the field of view, in a "
        f"scene {min(depths):.2f} to {max(depths):.2f} m deep, as the models found it: poses "
        "and known frames alone tell.",
        table("seed", [*each, *rows("all", reported, QUALITY.sparse)]),
        f"Limits on the seeds on which one was chosen ({', '.join(map(str, options.chosen_on))}): that with the "
        f"largest difference between the shares of errors over {LARGE_M:g} m and of others that it calls "
        "sparsely covered.",
        table("limit", by_limit, "difference"),
    )


if __name__ == "__main__":
    main()
