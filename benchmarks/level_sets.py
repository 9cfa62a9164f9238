"""Volumes of joint regions with the default learner: level sets of the joint density, and products ("max").

python benchmarks/level_sets.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from common import mean_interval, write_table

from conformodal import ConformalRegressor

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from problems import read_table

ALPHA, SEEDS, MOST_TEST = 0.1, 5, 1000
RULES = ("max", "density")


def main() -> None:
    rows = []
    for name in ("energy", "temperature"):
        X, Y, _ = read_table(name)
        found: dict[str, list[tuple[float, float]]] = {rule: [] for rule in RULES}
        for seed in range(SEEDS):
            order = np.random.default_rng(seed).permutation(len(X))
            test, train = order[: len(X) // 5][:MOST_TEST], order[len(X) // 5 :]
            values = (Y - Y[train].mean(axis=0)) / Y[train].std(axis=0)
            for rule in RULES:
                reg = ConformalRegressor(alpha=ALPHA, joint=rule, calibration_size=0.25, random_state=seed)
                regions = reg.fit(X[train], values[train]).predict_region(X[test])
                if rule == "max":
                    held, log = regions.contains(values[test], joint=True), np.log(regions.volume)
                else:
                    held, log = regions.contains(values[test]), regions.log_volume(400)
                found[rule].append((held.mean(), log.mean() / Y.shape[1]))
        for rule in RULES:
            held, log = (list(column) for column in zip(*found[rule], strict=True))
            rows.append([name, str(Y.shape[1]), rule, mean_interval(held, 3), mean_interval(log, 3)])
    notes = (
        f"alpha = {ALPHA}, default learner; 60 % training, 20 % calibration, 20 % test (up to {MOST_TEST} rows), drawn "
        f"at random; mean and 95 % interval over seeds 0 to {SEEDS - 1}. Log volume: mean over test rows, by the "
        "number of targets, which are in standard deviations; smaller is better."
    )
    header = ["data", "targets", "joint", "all held", "log volume per target"]
    write_table("level_sets", "Joint regions of any shape", "python benchmarks/level_sets.py", header, rows, notes)


if __name__ == "__main__":
    main()
