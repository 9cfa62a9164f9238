"""What joint coverage of several targets costs in volume: none, bonferroni and max on the same probabilities.

python benchmarks/joint.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from common import spread, write_table
from sklearn.ensemble import RandomForestClassifier

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.learning.learners import fit_target

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from problems import read_table

ALPHA, SEEDS, BINS = 0.1, 5, 30
RULES = ("none", "bonferroni", "max")


def data(name: str) -> tuple[np.ndarray, np.ndarray]:
    if name != "independent":
        X, Y, _ = read_table(name)
        return X, Y
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (6000, 2))
    scale = 0.3 * (1 + X[:, :1] ** 2)
    return X, X.sum(axis=1, keepdims=True) + scale * rng.standard_t([3, 5, 9, 30, 30, 30, 30], (6000, 7))


def main() -> None:
    rows = []
    for name in ("energy", "temperature", "births", "independent"):
        X, Y = data(name)
        found: dict[str, list[tuple[float, float, float]]] = {rule: [] for rule in RULES}
        for seed in range(SEEDS):
            train, cal, test = np.split(
                np.random.default_rng(seed).permutation(len(X)), [int(0.6 * len(X)), int(0.8 * len(X))]
            )
            bins = QuantileBins(BINS, margin=0.02).fit(Y[train])
            proba: dict[str, list[np.ndarray]] = {"train": [], "cal": [], "test": []}
            for j, edges in enumerate(bins.edges_):
                forest = RandomForestClassifier(100, min_samples_leaf=5, n_jobs=2, random_state=seed)
                learnt = X[train], Y[train, j], edges
                model, out_of_fold = fit_target(forest, False, *learnt, None, True, None)
                proba["train"].append(out_of_fold)
                for part, index in (("cal", cal), ("test", test)):
                    proba[part].append(model.predict_proba(X[index]))
            for rule in RULES:
                sets = SplitConformal(bins, ALPHA, "density", rule).fit_scale(proba["train"], Y[train])
                regions = sets.calibrate(proba["cal"], Y[cal]).predict(proba["test"])
                inside = regions.contains(Y[test])
                # volume as the side of a cube of that volume, in standard deviations of the targets
                side = np.log(np.maximum(regions.length / Y[train].std(axis=0), 1e-3)).mean()
                found[rule].append((inside.mean(), inside.all(axis=1).mean(), float(np.exp(side))))
        base = np.array([side for *_, side in found["none"]])
        for rule in RULES:
            each, joint, side = (list(column) for column in zip(*found[rule], strict=True))
            cost = list((np.array(side) / base) ** Y.shape[1])
            fields = (spread(each, 3), spread(joint, 3), spread(side, 3), spread(cost, 1))
            rows.append([name, str(Y.shape[1]), rule, *fields])
    notes = (
        f"alpha = {ALPHA}, score density, {BINS} bins, random forests; 60 % training, 20 % calibration, 20 % test, "
        f"drawn at random, so samples are exchangeable; median (range) over seeds 0 to {SEEDS - 1}. Promised: each "
        "target with 0.9 (none), all with 0.9 (bonferroni, max). Side: geometric mean of the lengths, in standard "
        "deviations, over targets and samples; volume: relative to none, per sample in the geometric mean. "
        "`independent`: seven targets with tails of different weight, noise independent."
    )
    header = ["data", "targets", "joint", "each target held", "all held", "side", "volume / none"]
    write_table("joint", "What joint coverage costs", "python benchmarks/joint.py", header, rows, notes)


if __name__ == "__main__":
    main()
