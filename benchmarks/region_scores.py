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
from conformodal.localization import FrameEvidence, pose_targets
from conformodal.odometry import (
    ModelConfig,
    VisualOdometry,
    prepare_training_data,
    train_model,
)
from conformodal.vision import FeatureCache, TrainingConfig, default_cache_dir, extract_features

SEEDS, NOISE = range(3), (0.0, 0.05, 0.1, 0.2)
SCORES = ("lac", "density", "hpd", "aps")
ALPHA, USED = 0.1, 0.4
WITH, ALONE = "all sources", "without local features"
Results = dict[tuple[tuple[str, str, float | str], str], list[float]]


def one(seed: int, results: Results) -> None:
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    cache = FeatureCache(default_cache_dir())
    training = TrainingConfig(seed=seed)
    config = ModelConfig(alpha=ALPHA, calibration=USED / 5, used=USED, seed=seed, training=training)
    data = prepare_training_data(sequence, config, cache)
    model = train_model(data, config)
    held_out, test = data.split.calibration, data.split.test
    truth = sequence.require_truth()[test]
    targets = pose_targets(truth, model.sign_reference)
    widths = np.array([e[-1] - e[0] for e in model.bins.edges_])
    localizer, images = model.localizer, data.features[held_out]
    evidence = FrameEvidence(images, data.for_sources(config).local_features(held_out))
    marginals = {
        WITH: localizer.marginals(localizer.beliefs(evidence)),
        ALONE: localizer.marginals(localizer.beliefs(FrameEvidence(images))),
    }
    rules = {
        (name, what): SplitConformal(localizer.cells, ALPHA, name, "bonferroni").calibrate(
            proba, data.targets[held_out]
        )
        for name in SCORES
        for what, proba in marginals.items()
    }
    sizes, errors = defaultdict(list), []
    for sigma in NOISE:
        noisy = replace(sequence, noise=PixelNoise(sigma, seed) if sigma else None)
        run = VisualOdometry(model).process(noisy, test, cache=cache)
        assert len(run.frames) == len(test)
        paths = [sequence.image_paths[i] for i in test]
        features = extract_features(paths, model.backbone, cache, noise=noisy.noise)
        found = {WITH: run.localization.beliefs, ALONE: localizer.beliefs(FrameEvidence(features))}
        errors.append(np.linalg.norm(run.trajectory.positions_xyz - truth.positions_xyz, axis=1))
        for name, rule in rules.items():
            regions = rule.predict(localizer.marginals(found[name[1]]))
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
