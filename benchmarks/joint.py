"""What joint coverage of several targets costs in volume: none, bonferroni and max on the same probabilities.

python benchmarks/joint.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from common import SEEDS, mean_interval, parser_of, write_table
from sklearn.ensemble import RandomForestClassifier

from conformodal.conformal import QuantileBins, QuickDensity, SplitConformal
from conformodal.conformal.density.learners import fit_target, predict_proba

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from problems import read_table

ALPHA, MANY, FEW = 0.1, 2000, 600
RULES = ("none", "bonferroni", "max")
CASES = [(name, "forest", MANY) for name in ("energy", "temperature", "births", "air", "independent")]
CASES += [(name, "default", FEW) for name in ("energy", "temperature", "births")]


def data(name: str) -> tuple[np.ndarray, np.ndarray]:
    if name != "independent":
        X, Y, _ = read_table(name)
        return X, Y
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (6000, 2))
    scale = 0.3 * (1 + X[:, :1] ** 2)
    return X, X.sum(axis=1, keepdims=True) + scale * rng.standard_t([3, 5, 9, 30, 30, 30, 30], (6000, 7))


def measured(name: str, learner: str, most_rows: int, seed: int) -> dict[str, tuple[float, float, float]]:
    """Coverage of a target and of all, and side (geometric mean length in standard deviations), by rule."""
    X, Y = data(name)
    order = np.random.default_rng(seed).permutation(len(X))[:most_rows]
    train, cal, test = np.split(order, [int(share * len(order)) for share in (0.6, 0.8)])
    dense = learner == "default"
    bins = QuantileBins(200 if dense else 30, margin=0.02).fit(Y[train])
    base = QuickDensity(random_state=seed) if dense else RandomForestClassifier(min_samples_leaf=5, random_state=seed)
    proba: dict[str, list[np.ndarray]] = {"unseen": [], "cal": [], "test": []}
    for j, edges in enumerate(bins.edges_):
        fitted = fit_target(base, dense, X[train], Y[train, j], edges, None, True)
        assert fitted.first is not None
        proba["unseen"].append(fitted.first)
        for part, index in (("cal", cal), ("test", test)):
            proba[part].append(predict_proba(fitted.model, X[index]))
    spread = np.where(Y[train].std(axis=0) > 0, Y[train].std(axis=0), Y.std(axis=0))  # a rare label may be in no row
    numbers = {}
    for rule in RULES:
        sets = SplitConformal(bins, ALPHA, "density", rule)
        sets.fit_scale(proba["unseen"], Y[train[: len(proba["unseen"][0])]])
        regions = sets.calibrate(proba["cal"], Y[cal]).predict(proba["test"])
        inside = regions.contains(Y[test])
        side = np.log(np.maximum(regions.length / spread, 1e-3)).mean()
        numbers[rule] = float(inside.mean()), float(inside.all(axis=1).mean()), float(np.exp(side))
    return numbers


def main() -> None:
    parser_of(__doc__).parse_args()
    rows = []
    for name, learner, most_rows in CASES:
        runs = [measured(name, learner, most_rows, seed) for seed in SEEDS]
        n_targets = data(name)[1].shape[1]
        for rule in RULES:
            each, joint, side = (list(column) for column in zip(*(run[rule] for run in runs), strict=True))
            over = [(run[rule][2] / run["bonferroni"][2]) for run in runs]
            fields = (mean_interval(values, 3) for values in (each, joint, side, over))
            rows.append([f"{name}, {learner}", str(n_targets), rule, *fields])
    notes = (
        f"alpha = {ALPHA}, score density; 60 % training, 20 % calibration, 20 % test, drawn at random, so samples are "
        f"exchangeable; mean ± half of the 95 % interval over seeds {SEEDS[0]} to {SEEDS[-1]}. Forests on 30 bins, of "
        f"at most {MANY} rows; the default learner on 200 bins, of {FEW} rows. Guaranteed: each target with 0.9 "
        "(none), all with 0.9 (bonferroni, max). Side: geometric mean of the lengths, in standard deviations, over "
        "targets and samples; with d targets a side 0.9 times as long means a volume 0.9^d times as large. "
        "`independent`: seven targets with tails of different weight, noise independent."
    )
    header = ["data, learner", "targets", "joint", "each target held", "all held", "side", "side / bonferroni"]
    write_table("joint", "What joint coverage costs", "python benchmarks/joint.py", header, rows, notes)


if __name__ == "__main__":
    main()
