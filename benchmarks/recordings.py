"""Map one recording, answer another: TUM freiburg1, from fr1_desk to fr1_xyz and back; ours and the paper's system.

python benchmarks/recordings.py [--seed 10] [--runs FOLDER]
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from common import DATA, RESULTS, ROOT, cached_json, write_table

from conformodal.core.files import default_cache_dir
from conformodal.datasets import SplitKind, read_sequence
from conformodal.datasets.joining import near_known
from conformodal.localization.targets import pose_targets
from conformodal.model.config import Method, ModelConfig
from conformodal.model.store import load_model, save_model
from conformodal.running.paper_odometry import odometry_of
from conformodal.training.training import prepare_training_data, train_model
from conformodal.vision.features import FeatureCache

PAIRS = (("fr1_desk", "fr1_xyz"), ("fr1_xyz", "fr1_desk"))
NEAR_M, NEAR_RAD, ALPHA = 0.3, np.radians(30.0), 0.1
SYSTEMS = {Method.CONFORMODAL: "ours", Method.PAPER: "the paper's"}


def measured(source: str, target: str, seed: int, runs: Path, method: Method) -> dict[str, dict[str, float]]:
    """Numbers of the frames of `target` that lie near a frame of `source`, by what regions and poses rest on.

    The paper's system is calibrated as the paper says: on random frames of the training recording.
    """
    cache, folder = FeatureCache(default_cache_dir()), runs / f"{source}-{seed}-{method}"
    known, new = (read_sequence(DATA / "tum" / name) for name in (source, target))
    if not (folder / "model.json").is_file():
        make = ModelConfig.paper if method is Method.PAPER else ModelConfig
        config = make(split=SplitKind.BLOCKS, seed=seed, alpha=ALPHA)
        save_model(train_model(prepare_training_data(known, config, cache), config), folder)
    model = load_model(folder)
    run = odometry_of(model).process(new, new.posed, cache=cache)
    truth, views = new.poses[np.searchsorted(new.posed, run.frames)], known.require_truth()
    near = near_known(truth, views, NEAR_M, NEAR_RAD)
    targets, found = pose_targets(truth, model.sign_reference), {}
    regions = {"image alone": run.regions, **run.path_regions}
    alone = np.array([its.positions_xyz[np.argmax(its.log_mass)] for its in run.candidates])
    for name, positions in {"image alone": alone, **{k: t.positions_xyz for k, t in run.trajectories.items()}}.items():
        off = np.linalg.norm(positions - truth.positions_xyz, axis=1)[near]
        found[name] = {"rmse_m": float(np.sqrt(np.mean(off**2))), "median_m": float(np.median(off))}
        if name in regions:
            bounded = ~regions[name].unbounded.any(axis=1) & near
            held, each = regions[name].contains(targets, joint=True), regions[name].contains(targets)[bounded]
            found[name] |= {
                "unbounded": float(1 - bounded.sum() / near.sum()),
                "coverage": float(held[bounded].mean()),
                "least_target": float(each.mean(axis=0).min()),
                "most_target": float(each.mean(axis=0).max()),
                "length_m": float(np.median(regions[name].length[bounded, :3].mean(axis=1))),
            }
    found[run.answer]["reliable"] = float(run.reliable[near].mean())
    return found | {"frames": {"near": int(near.sum()), "all": len(near)}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=10)
    parser.add_argument("--runs", type=Path, default=ROOT / "recordings-out")
    asked = parser.parse_args()
    columns = ("rmse_m", "median_m", "unbounded", "coverage", "least_target", "most_target", "length_m", "reliable")
    rows = []
    for (source, target), method in product(PAIRS, SYSTEMS):
        file = RESULTS / "recordings" / f"{source}-{asked.seed}-{method}.json"
        found = cached_json(file, partial(measured, source, target, asked.seed, asked.runs, method))
        frames = found.pop("frames")
        for name, row in found.items():
            numbers = [f"{row[key]:.3f}" if key in row else "" for key in columns]
            shown = f"{target} from {source}, {frames['near']} of {frames['all']} frames"
            rows.append([shown, SYSTEMS[method], name, *numbers])
    note = (
        f"Frames with a known view within {NEAR_M} m and 30 degrees. Split `blocks`, seed {asked.seed}, alpha {ALPHA}: "
        "stretches of the mapped recording calibrate, so nothing is guaranteed for another recording. Coverage is that "
        "of bounded regions, of the whole pose, and of the least and the most covered target; the paper asks 0.9 of "
        "each target, ours of the whole pose. Length is the median over frames of the mean along x, y and z."
    )
    line = f"python benchmarks/recordings.py --seed {asked.seed}"
    write_table(
        "recordings", "Another recording of a known place", line, ["frames", "system", "from", *columns], rows, note
    )


if __name__ == "__main__":
    main()
