"""Regions by score under pixel noise, with landmarks and without: coverage, size, and whether size follows the error.

python benchmarks/region_scores.py
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from common import DATA, spread, write_table
from scipy.stats import spearmanr

from conformodal.conformal import SplitConformal
from conformodal.datasets import PixelNoise, read_sevenscenes
from conformodal.odometry import (
    ModelConfig,
    VisualOdometry,
    learn_scene,
    pose_targets,
    prepare_training_data,
    train_model,
)
from conformodal.reasoning import fix_cells, pool_fixes
from conformodal.vision import FeatureCache, TrainingConfig, default_cache_dir, extract_features

SEEDS, NOISE = range(3), (0.0, 0.05, 0.1, 0.2)
SCORES = ("lac", "density", "hpd", "aps")
ALPHA, USED = 0.1, 0.4
WITH, ALONE = "softmax and landmarks", "softmax alone"
Results = dict[tuple[tuple[str, str, float | str], str], list[float]]


def one(seed: int, results: Results) -> None:
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    cache = FeatureCache(default_cache_dir())
    training = TrainingConfig(seed=seed)
    config = ModelConfig(alpha=ALPHA, calibration=USED / 5, used=USED, seed=seed, training=training)
    data = prepare_training_data(sequence, config, cache)
    scene = learn_scene(sequence, data.split)
    model = train_model(data, config, scene=scene)
    held_out, test = data.split.calibration, data.split.test
    truth = sequence.require_truth()[test]
    targets = pose_targets(truth, model.sign_reference)
    widths = np.array([e[-1] - e[0] for e in model.bins.edges_])
    assert scene.region_landmarks is not None
    alone, cells = model.proba(data.features[held_out]), fix_cells(model.bins)
    pooled = pool_fixes(alone, scene.calibration_fixes, model.bins, cells, model.sign_reference)
    rules = {}
    for name in SCORES:
        for what, bins, proba in ((WITH, cells, pooled), (ALONE, model.bins, alone)):
            rule = SplitConformal(bins, ALPHA, name, "bonferroni")
            rules[name, what] = rule.calibrate(proba, data.targets[held_out])
    sizes, errors = defaultdict(list), []
    for sigma in NOISE:
        noisy = replace(sequence, noise=PixelNoise(sigma, seed) if sigma else None)
        run = VisualOdometry(model).process(noisy, test, cache=cache)
        assert len(run.frames) == len(test)
        proba = model.proba(
            extract_features([sequence.image_paths[i] for i in test], model.backbone, cache, noise=noisy.noise)
        )
        errors.append(np.linalg.norm(run.trajectory.positions_xyz - truth.positions_xyz, axis=1))
        for name, rule in rules.items():
            regions = model.regions(proba, run.fixes if name[1] == WITH else None, rule)
            length = np.minimum(regions.length, widths)
            sizes[name].append(np.linalg.norm(length[:, :3], axis=1))
            results[(*name, sigma), "held"].append(float(regions.contains(targets, joint=True).mean()))
            results[(*name, sigma), "length"].append(float((length.mean(axis=0) / targets.std(axis=0)).mean()))
    for name, parts in sizes.items():
        rank = spearmanr(np.concatenate(parts), np.concatenate(errors)).statistic
        results[(*name, "all"), "rank"].append(float(rank))


def main() -> None:
    results: Results = defaultdict(list)
    for seed in SEEDS:
        one(seed, results)
    rows = []
    for name in ((score, what) for what in (WITH, ALONE) for score in SCORES):
        row = list(name)
        for sigma in NOISE:
            at = (*name, sigma)
            row += [spread(results[at, "held"], 2), spread(results[at, "length"], 2)]
        rows.append([*row, spread(results[(*name, "all"), "rank"], 2)])
    header = ["score", "region from"]
    for sigma in NOISE:
        header += [f"held, noise {sigma:g}", "set length"]
    header.append("size against error, all noises")
    note = (
        f"{USED:.0%} of the frames for training and calibration, else as in table 1 (`interleaved`); median (range) "
        f"over seeds {SEEDS[0]} to {SEEDS[-1]}. Held: whole pose, alpha = {ALPHA} (bonferroni), promised without noise "
        "and an observation with it. Set length: in standard deviations of the test targets, mean over targets. Size "
        "against error: rank correlation of the position region's size and the smoothed answer's error, frames of all "
        "noises together."
    )
    title = "Scores of the pose region under pixel noise"
    write_table("region_scores", title, "python benchmarks/region_scores.py", header, rows, note)


if __name__ == "__main__":
    main()
