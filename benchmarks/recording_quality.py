"""Are errors where a recording is called thin? Judged from poses and known frames, before any error is looked at.

python benchmarks/recording_quality.py [--seeds 10 11 12] [--chosen-on 0 1 2] [--runs FOLDER]

redkitchen, ``blocks``, regions calibrated on frames (one fit instead of six). The frames of a seed are kept in the
folder of runs and not measured again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, ROOT, write_page

from conformodal.datasets import SplitKind, read_sevenscenes
from conformodal.odometry import (
    Calibration,
    ModelConfig,
    VisualOdometry,
    depth_or_default,
    prepare_training_data,
    provenance,
    train_model,
)
from conformodal.odometry.quality import QUALITY, ViewScale, pose_coverage
from conformodal.vision import FeatureCache, default_cache_dir

LARGE_M = 0.1
LIMITS = (0.05, 0.1, 0.15, 0.2, 0.25)


def measured(seed: int, cache: Path) -> dict[str, Any]:
    """Of each frame of the test part: what poses say of it, and then the errors of its answers."""
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    config = ModelConfig(split=SplitKind.BLOCKS, calibrate_on=Calibration.FRAMES, seed=seed)
    data = prepare_training_data(sequence, config, FeatureCache(cache))
    model = train_model(data, config, checkpoint_dir=cache / "training")
    truth = sequence.require_truth()
    scale = ViewScale.of(sequence.camera, depth_or_default(model.prior.depth_m))
    coverage = pose_coverage(truth, sequence.recording, truth[model.localizer.frames], scale)
    run = VisualOdometry(model).process(sequence, model.split.test, cache=FeatureCache(cache))
    tops = [c.positions_xyz[int(np.argmax(c.log_mass))] for c in run.localization.candidates]
    own = truth.positions_xyz[run.frames]
    return {
        "seed": seed,
        "source": provenance()["source_revision"],
        "depth_m": scale.depth_m,
        "frame": run.frames.tolist(),
        "change": coverage.change[run.frames].tolist(),
        "answer_m": np.linalg.norm(run.trajectory.positions_xyz - own, axis=1).tolist(),
        "single_m": np.linalg.norm(np.array(tops) - own, axis=1).tolist(),
        "unknown": (~run.localization.known).tolist(),
    }


def kept(seed: int, runs: Path, cache: Path) -> dict[str, Any]:
    """The numbers of a seed, measured once."""
    path = runs / f"redkitchen-{seed}.json"
    if not path.exists():
        runs.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(measured(seed, cache)), encoding="utf-8")
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def row(name: str, results: list[dict[str, Any]], limit: float) -> list[str]:
    """Errors where the nearest known view differs by more than the limit, and elsewhere."""
    change, answer, single = (
        np.concatenate([result[k] for result in results]) for k in ("change", "answer_m", "single_m")
    )
    cells = [name]
    for part in (change > limit, change <= limit):
        if not part.any():
            cells += ["0", "", "", ""]
            continue
        cells += [
            str(int(part.sum())),
            f"{np.median(answer[part]):.3f}",
            f"{100 * np.mean(answer[part] > LARGE_M):.0f}",
            f"{np.median(single[part]):.3f}",
        ]
    return cells


def lines(header: list[str], rows: list[list[str]]) -> list[str]:
    head = [f"| {' | '.join(header)} |", f"| {' | '.join('---' for _ in header)} |"]
    return head + [f"| {' | '.join(cells)} |" for cells in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12])
    parser.add_argument("--chosen-on", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=ROOT / "quality-out")
    parser.add_argument("--cache", type=Path, default=default_cache_dir())
    options = parser.parse_args()
    chosen = [kept(seed, options.runs, options.cache) for seed in options.chosen_on]
    reported = [kept(seed, options.runs, options.cache) for seed in options.seeds]
    header = [
        f"{kind}: {what}"
        for kind in ("thin", "others")
        for what in ("frames", "median error, m", f"% over {LARGE_M:g} m", "median error of one frame alone, m")
    ]
    rows = [row(str(result["seed"]), [result], QUALITY.thin) for result in reported]
    rows.append(row("all", reported, QUALITY.thin))
    by_limit = [row(f"{limit:g}", chosen, limit) for limit in LIMITS]
    depths = [result["depth_m"] for result in chosen + reported]
    write_page(
        "recording_quality",
        "Errors where a recording is called thin",
        "python benchmarks/recording_quality.py",
        [
            f"redkitchen sequence 01, `blocks`, regions calibrated on frames; the test part. A frame is called thin if "
            f"the nearest view that the model knows differs by more than {QUALITY.thin:g} of the field of view (scene "
            f"depth {min(depths):.2f} to {max(depths):.2f} m, as the models found it): poses and known frames alone "
            "tell. Errors are of the answer (the smoothed path), and of the most probable hypothesis of each frame "
            "alone.",
            "",
            *lines(["seed", *header], rows),
            "",
            f"Other limits, on the seeds on which the limit was chosen ({', '.join(map(str, options.chosen_on))}):",
            "",
            *lines(["limit", *header], by_limit),
        ],
    )


if __name__ == "__main__":
    main()
