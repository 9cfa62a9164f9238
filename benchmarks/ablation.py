"""What each choice in features, labels, means and candidates is worth, on redkitchen.

python benchmarks/ablation.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from common import DATA, spread, write_table

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.datasets import SplitKind, read_sevenscenes
from conformodal.odometry import ModelConfig, TrainingData, prepare_training_data
from conformodal.reasoning import interval_candidates, mode_candidates, softmax_mean
from conformodal.vision import (
    FeatureCache,
    TrainingConfig,
    default_cache_dir,
    feature_views,
    fit_head,
    predict_proba,
    soft_cross_entropy,
)

SEEDS = range(3)
Proba = list[npt.NDArray[np.floating[Any]]]


def labels(
    bins: QuantileBins, targets: npt.NDArray[np.float64], sigma: float, centred: bool
) -> npt.NDArray[np.float64]:
    if centred:  # forget where in its bin a value lies
        codes = bins.encode(np.clip(targets, [e[0] for e in bins.edges_], [e[-1] for e in bins.edges_]))
        targets = np.column_stack([c[k] for c, k in zip(bins.centers, codes.T, strict=True)])
    return np.concatenate(bins.soft_targets(targets, sigma), axis=1)


def mean_in_metres(proba: Proba, bins: QuantileBins) -> npt.NDArray[np.float64]:
    return np.stack([p @ c for p, c in zip(proba, bins.centers, strict=True)], axis=1)


def rmse(positions: npt.NDArray[np.float64], data: TrainingData) -> float:
    truth = data.targets[data.split.test, :3]
    return float(np.sqrt(np.mean(np.sum((positions[:, :3] - truth) ** 2, axis=1))))


def one(
    data: TrainingData,
    seed: int,
    sigma: float,
    centred: bool,
    grid: bool,
    components: int | None = 256,
    view: str = "network",
) -> dict[str, float]:
    bins = QuantileBins(50, margin=0.02).fit(data.targets[data.split.train])
    features = np.ascontiguousarray(data.features[:, getattr(feature_views(data.features.shape[1]), view)])
    if not grid:  # what a global average of the same map would leave
        features = features.reshape(len(features), 80, -1).mean(axis=2)
    train, held_out, test = data.split.train, data.split.calibration, data.split.test
    soft = labels(bins, data.targets[train], sigma, centred)
    head = fit_head(
        features[train], soft, bins.sizes, soft_cross_entropy, TrainingConfig(seed=seed, components=components)
    )
    proba = predict_proba(head, features[test])
    calibration = SplitConformal(bins, 0.1, "lac").calibrate(
        predict_proba(head, features[held_out]), data.targets[held_out]
    )
    regions = calibration.predict(proba)
    deviation = data.targets[train].std(axis=0)
    return {
        "metres": rmse(mean_in_metres(proba, bins), data),
        "bins": rmse(softmax_mean(proba, bins), data),
        "interval": rmse(np.array([c.positions_xyz[0] for c in interval_candidates(proba, regions)]), data),
        "mode": rmse(np.array([c.positions_xyz[0] for c in mode_candidates(proba, bins)]), data),
        "length": float((regions.length / deviation).mean()),
        "intervals": float(regions.n_intervals.mean()),
    }


def main() -> None:
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    cache = FeatureCache(default_cache_dir())
    shipped = (0.7, False, True, 256)
    labels_and_grid = {
        "256 components, Gaussian 0.7 bins around the value": shipped,
        "Gaussian 0.7 bins around the bin's middle": (0.7, True, True, 256),
        "Gaussian 1.5 bins around the value": (1.5, False, True, 256),
        "Gaussian 1.5 bins around the bin's middle": (1.5, True, True, 256),
        "one-hot, as in the paper": (0.0, True, True, 256),
        "features averaged over the image": (0.7, False, False, 256),
        "all 3840 features": (0.7, False, True, None),
        "128 components": (0.7, False, True, 128),
        "64 components": (0.7, False, True, 64),
        "the thumbnail alone": (0.7, False, True, 256, "thumbnail"),
        "the network's map and the thumbnail": (0.7, False, True, 256, "both"),
    }
    variants = {("interleaved", name): settings for name, settings in labels_and_grid.items()}
    for name in ("256 components, Gaussian 0.7 bins around the value", *list(labels_and_grid)[-5:]):
        variants["blocks", name] = labels_and_grid[name]
    variants["blocks", "64 components, Gaussian 2 bins around the value"] = (2.0, False, True, 64)
    keys = ("metres", "bins", "interval", "mode", "length", "intervals")
    rows = []
    for (split, name), settings in variants.items():
        results = []
        for seed in SEEDS:
            data = prepare_training_data(sequence, ModelConfig(seed=seed, split=SplitKind(split)), cache)
            results.append(one(data, seed, *settings))
        rows.append(
            [
                split,
                name,
                *(spread([r[k] for r in results], 2 if k.startswith("inter") and k != "interval" else 4) for k in keys),
            ]
        )
    header = [
        "split",
        "features and labels",
        "softmax mean in metres, rmse_m",
        "softmax mean in bin coordinates",
        "best cuboid of the region, at its intervals' means",
        "best mode, at its basin's mean",
        "set length (standard deviations)",
        "intervals per target",
    ]
    note = "Median and range over seeds 0 to 2 of split and training. Sets: lac, alpha = 0.1, per target. No reasoning."
    title = "Features, labels, means and candidates: redkitchen, 640 training frames"
    write_table("ablation", title, "python benchmarks/ablation.py", header, rows, note)


if __name__ == "__main__":
    main()
