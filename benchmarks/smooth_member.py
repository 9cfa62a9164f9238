"""What the Gaussian process gives the default learner of tables: mean length, coverage and time with and without it.

python benchmarks/smooth_member.py
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
from common import DATA, parser_with_seeds, write_table
from sklearn.datasets import load_diabetes, make_friedman1, make_friedman2, make_friedman3

from conformodal.conformal import ConformalRegressor
from conformodal.conformal.density import named

sys.path.insert(0, str(Path(__file__).with_name("peers")))
from problems import bimodal, read_table

MOST = 800  # rows to learn from; a half of a small table
FILES = ("concrete", "energy", "temperature", "bio", "births", "air")
MADE = {
    "friedman1": (make_friedman1, 1.0), "friedman2": (make_friedman2, 60.0), "friedman3": (make_friedman3, 0.1),
}  # fmt: skip
TABLES = (*FILES, "house sales", "diabetes", *MADE, "bimodal")


def data(name: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    if name in FILES:
        X, Y, _ = read_table(name)
        return X, Y[:, 0]
    if name == "house sales":
        frame = pd.read_csv(DATA / "tables_raw" / "house_sales.csv").select_dtypes("number")
        return frame.drop(columns=["price", "id"], errors="ignore").to_numpy(float), frame["price"].to_numpy(float)
    if name == "diabetes":
        return load_diabetes(return_X_y=True)
    if name == "bimodal":
        return bimodal(2500, seed)
    make, noise = MADE[name]
    return make(2500, noise=noise, random_state=seed)


def measured(name: str, seed: int) -> dict[str, float]:
    """Mean length in standard deviations, coverage and seconds of a fit, with the Gaussian process and without."""
    X, y = data(name, seed)
    order = np.random.default_rng(seed).permutation(len(y))
    n, n_cal = min(MOST, len(y) // 2), min(400, len(y) // 5)
    train, cal, test = np.split(order[: n + n_cal + 1000], [n, n + n_cal])
    numbers = {}
    for kind, make in (("with", named.smooth_member), ("without", lambda *args: None)):
        with patch.object(named, "smooth_member", make):
            start = time.process_time()
            reg = ConformalRegressor(calibration_size=0, random_state=seed).fit(X[train], y[train])
            numbers[f"seconds {kind}"] = time.process_time() - start
        regions = reg.conformalize(X[cal], y[cal]).predict_region(X[test])
        numbers[f"length {kind}"] = float(regions.length.mean() / y[train].std())
        numbers[f"coverage {kind}"] = float(regions.contains(y[test]).mean())
    return numbers


def main() -> None:
    seeds = parser_with_seeds(__doc__).parse_args().seeds
    rows, logs = [], []
    for name in TABLES:
        runs = [measured(name, seed) for seed in seeds]
        logs.append(np.mean([np.log(run["length with"] / run["length without"]) for run in runs]))
        means = [[np.mean([run[f"{what} {kind}"] for run in runs]) for kind in ("without", "with")] for what in
                 ("length", "coverage", "seconds")]  # fmt: skip
        rows.append([name, *(f"{a:.3f}" for a in means[0]), f"{np.exp(logs[-1]):.3f}",
                     *(f"{a:.3f}" for a in means[1]), *(f"{a:.1f}" for a in means[2])])  # fmt: skip
        print(*rows[-1], flush=True)
    rows.append(["geometric mean", "", "", f"{np.exp(np.mean(logs)):.3f}", "", "", "", ""])
    notes = (
        f"alpha = 0.1; {MOST} rows to learn from (half of smaller tables), at most 400 to calibrate and 1000 new ones, "
        f"drawn at random with {len(seeds)} seeds, for both alike. Length: mean in standard deviations of the training "
        "values, shorter is better; ratio: geometric mean over the seeds. Seconds: of a fit, on one core."
    )
    header = ["table", "length without", "with", "ratio", "coverage without", "with", "seconds without", "with"]
    write_table(
        "smooth_member", "The Gaussian process of the default learner", "python benchmarks/smooth_member.py", header,
        rows, notes,
    )  # fmt: skip


if __name__ == "__main__":
    main()
