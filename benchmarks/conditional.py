"""Coverage in groups that overlap: one threshold for all, one for each combination of groups, or a function of them.

python benchmarks/conditional.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, SEEDS, mean_interval, parser_of, write_table

from conformodal.conformal import (
    ConditionalConformal,
    MondrianConformal,
    QuantileBins,
    QuickDensity,
    Regions,
    SplitConformal,
)
from conformodal.core.arrays import BoolArray, FloatArray

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from problems import read_table

ALPHA, TRAIN, CAL, LEAST = 0.1, 2000, 1000, 0.02
METHODS = ("one threshold", "one per combination", "conditional")


def births(of: dict[str, FloatArray]) -> list[BoolArray]:
    named = [name for name in of if name.startswith(("race_mother", "marital", "gender", "delivery"))]
    others = [of["plurality"] > 1, of["cigarettes_during_pregnancy"] > 0, of["pregnancy_duration"] < 37]
    return [of[name] > 0 for name in named] + others


def air(of: dict[str, FloatArray]) -> list[BoolArray]:
    return [of[name] > 0 for name in of if name.startswith(("Land", "Location"))]


def temperature(of: dict[str, FloatArray]) -> list[BoolArray]:
    thirds = [(of[name], np.quantile(of[name], (1 / 3, 2 / 3))) for name in ("DEM", "Solar_radiation", "LDAPS_CC1")]
    return [np.searchsorted(cuts, values) == k for values, cuts in thirds for k in range(3)]


TABLES = {"births": births, "air": air, "temperature": temperature}


def measured(name: str, seed: int) -> dict[str, dict[str, Any]]:
    X, Y, _ = read_table(name)
    header = (DATA / "tables" / f"{name}.csv").open(encoding="utf-8").readline().strip().split(",")
    groups = np.column_stack(TABLES[name](dict(zip([c for c in header if not c.startswith("y_")], X.T, strict=True))))
    y = Y[:, 0]
    train, cal, test = np.split(np.random.default_rng(seed).permutation(len(X)), [TRAIN, TRAIN + CAL])
    groups = groups[:, groups.mean(axis=0) >= LEAST]
    bins = QuantileBins(200, margin=0.02).fit(y[train])
    density = QuickDensity(random_state=seed).fit_bins(X[train], y[train], bins.edges_[0])
    proba_cal, proba = density.predict_proba(X[cal]), density.predict_proba(X[test])
    labels = np.unique(groups, axis=0, return_inverse=True)[1].ravel()  # of the combination of groups
    how = bins, ALPHA, "density"
    regions = {
        METHODS[0]: SplitConformal(*how).calibrate(proba_cal, y[cal]).predict(proba),
        METHODS[1]: MondrianConformal(*how).calibrate(proba_cal, y[cal], labels[cal]).predict(proba, labels[test]),
        METHODS[2]: ConditionalConformal(*how).calibrate(proba_cal, y[cal], groups[cal]).predict(proba, groups[test]),
    }
    return {method: described(each, y[test], groups[test], y[train].std()) for method, each in regions.items()}


def described(regions: Regions, y: FloatArray, groups: BoolArray, spread: float) -> dict[str, Any]:
    held, bounded = regions.contains(y)[:, 0], ~regions.unbounded[:, 0]
    return {
        "all": float(held.mean()),
        "by_group": [float(held[group].mean()) for group in groups.T],
        "length": float(regions.length[bounded, 0].mean() / spread),
        "unbounded": float(1 - bounded.mean()),
    }


def main() -> None:
    parser_of(__doc__).parse_args()
    rows = []
    for name in TABLES:
        runs = [measured(name, seed) for seed in SEEDS]
        for method in METHODS:
            results = [run[method] for run in runs]
            by_group = sorted(
                (list(each) for each in zip(*(run["by_group"] for run in results), strict=True)), key=np.mean
            )
            every, length, unbounded = ([run[key] for run in results] for key in ("all", "length", "unbounded"))
            shown = [every, by_group[0], by_group[-1], length, unbounded]
            rows.append([name, str(len(by_group)), method, *(mean_interval(values, 3) for values in shown)])
    notes = (
        f"alpha = {ALPHA}, score density, default learner; {TRAIN} training rows, {CAL} calibration rows, the rest "
        "for testing, drawn at random, so rows are exchangeable; mean ± half of the 95 % interval over seeds "
        f"{SEEDS[0]} to {SEEDS[-1]}. "
        f"Groups of at least {LEAST:.0%} of the rows: births by the mother's race, marriage, delivery, the child's "
        "sex, twins, smoking and early birth; air by land use and setting; temperature by thirds of height, radiation "
        "and clouds. Least and most: coverage of the group that is covered least and most on average over seeds. "
        "Length: of bounded sets, in standard deviations. Guaranteed: 0.9 of all rows (one threshold), of each "
        "combination of groups (one per combination), of each group (conditional)."
    )
    header = ["data", "groups", "thresholds", "all", "least", "most", "length", "unbounded"]
    write_table("conditional", "Groups that overlap", "python benchmarks/conditional.py", header, rows, notes)


if __name__ == "__main__":
    main()
