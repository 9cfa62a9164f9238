"""conformodal beside its peers: same process, splits and seeds; alpha = 0.1.

pip install --no-deps -r benchmarks/peers/requirements.txt
python benchmarks/peers/run.py                     # the table of the runs that are there
python benchmarks/peers/run.py --measure           # first make the runs that are not; every finished one is kept
python benchmarks/peers/run.py --measure --methods r2ccp --seeds 40 --tables concrete
"""

from __future__ import annotations

import re
import time
import traceback
import warnings
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from measure import measure
from methods import METHODS, OURS, PEERS, PROBE, STACK
from problems import MAX_ROWS, TABLES, Split, draw

from conformodal.conformal import check_coverage, coverage_band

from common import RUNS, cached_json, mean_interval, parser_of, table_lines, write_page  # isort: skip - as above

ALPHA = 0.1
SPLITS = tuple(range(40, 50))
FEWER = 2  # splits of what is neither fast nor the best peer of a table: all ten take hours
ON_ALL_SPLITS = {
    OURS: TABLES,
    PROBE: TABLES,
    "MAPIE conditional": TABLES,
    "MAPIE CQR, boosting": ("air", "bimodal"),
    "TorchCP CQR": ("bimodal",),
}
SHOWN = {"size": 3, "components": 2, "hardest quarter": 3, "excess risk": 3, "seconds": 0}
Run = dict[str, Any]
Runs = dict[int, Run]  # by seed


def file_of(table: str, method: str, seed: int) -> Path:
    return RUNS / "peers" / table / f"{re.sub(r'[^a-z0-9]+', '-', method.lower())}-{seed}.json"


def run(method: str, split: Split) -> Run:
    start = time.process_time()
    record: Run = {"n_cal": len(split.y["cal"]), "n_test": len(split.y["test"]), "failed": None}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sets = METHODS[method](split, ALPHA)
        record["seconds"] = time.process_time() - start
        record |= measure(sets, split, ALPHA) | {"optimal": split.optimal_length}
        if not 0 < record["size"] < np.inf:
            record["failed"] = f"size is {record.pop('size')}"
    except Exception as exc:
        record["failed"] = f"{type(exc).__name__}: {exc}"
        traceback.print_exc()
    print(split.table, split.seed, method, {k: record.get(k) for k in ("size", "seconds", "failed")}, flush=True)
    return record


def measure_table(table: str, methods: list[str], seed: int) -> None:
    """All runs of a split that are not there."""
    split = draw(table, seed, ALPHA)
    for method in methods:
        cached_json(file_of(table, method, seed), partial(run, method, split))


def measure_all(tables: list[str], methods: list[str], seeds: list[int] | None) -> None:
    """Runs of the splits given, or of two, and of all ten where `ON_ALL_SPLITS` says so; two at a time."""

    def measured(table: str, seed: int) -> list[str]:
        if seeds is not None or seed in SPLITS[:FEWER]:
            return methods
        return [method for method in methods if table in ON_ALL_SPLITS.get(method, ())]

    every = SPLITS if seeds is None else seeds
    splits = [(table, measured(table, seed), seed) for seed in every for table in tables]
    Parallel(2, batch_size=1)(delayed(measure_table)(*each) for each in splits)


def load(table: str, method: str) -> Runs:
    files = {seed: file_of(table, method, seed) for seed in SPLITS}
    return {seed: cached_json(file, dict) for seed, file in files.items() if file.is_file()}


def valid(runs: Runs) -> bool:
    """Whether a run did not fail, and none of those covers less than its exact 99.99 % band allows."""
    good = [r for r in runs.values() if not r["failed"]]
    return bool(good) and not any(side(r, 0.9999) < 0 for r in good)


def side(run: Run, level: float = 0.99) -> int:
    """-1 below the band of a split's coverage, 0 in it, 1 above."""
    check = check_coverage(np.arange(run["n_test"]) < run["covered"], run["n_cal"], ALPHA, level)
    return 0 if check.inside else (1 if check.coverage > check.high else -1)


def row_of(table: str, method: str, runs: Runs) -> list[str]:
    good = [r for r in runs.values() if not r["failed"]]
    failed = str(len(runs) - len(good))
    if not good:
        return [table, method, *[""] * (2 + len(SHOWN)), failed]
    low, high = coverage_band(good[0]["n_cal"], good[0]["n_test"], ALPHA)
    shares = mean_interval([r["covered"] / r["n_test"] for r in good], 3)
    hits = f"{sum(side(r) == 0 for r in good)} of {len(good)}"
    shown = (mean_interval([r[k] for r in good if r[k] is not None], digits) for k, digits in SHOWN.items())
    return [table, method, f"{shares} [{low:.3f}, {high:.3f}]", hits, *shown, failed]


def ratios(ours: Runs, theirs: Runs) -> list[float]:
    """Ratios of sizes, one per seed that both have."""
    both = sorted(ours.keys() & theirs.keys())
    return [ours[s]["size"] / theirs[s]["size"] for s in both if not (ours[s]["failed"] or theirs[s]["failed"])]


def geometric(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--measure", action="store_true", help="make the runs that are not there")
    parser.add_argument("--tables", nargs="*", default=list(TABLES))
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--seeds", nargs="*", type=int, help="of the splits, for every method alike")
    args = parser.parse_args()
    if args.measure:
        measure_all(args.tables, args.methods, args.seeds)
    runs = {table: {method: load(table, method) for method in METHODS} for table in TABLES}
    rows, best_rows = [], []
    relative: dict[str, list[float]] = {method: [] for method in METHODS}  # sizes over the default's, by table
    against: dict[str, list[float]] = {OURS: [], STACK: []}  # sizes over the best peer's, by table
    for table, by_method in runs.items():
        rows += [row_of(table, method, by_seed) for method, by_seed in by_method.items() if by_seed]
        if optimal := [r["optimal"] for r in by_method[OURS].values() if r.get("optimal")]:
            rows.append(
                [table, "the shortest there can be", "0.900", "", mean_interval(optimal, 3), *[""] * len(SHOWN)]
            )
        for method in METHODS:
            if shared := ratios(by_method[method], by_method[OURS]):
                relative[method].append(geometric(shared))
        peers = {p: by_method[p] for p in PEERS if valid(by_method[p])}
        cells = [table]
        for method, sizes in against.items():
            by_peer = {p: shared for p in peers if (shared := ratios(by_method[method], peers[p]))}
            if not by_peer:
                cells.append("")
                continue
            best = max(by_peer, key=lambda p: geometric(by_peer[p]))
            sizes.append(geometric(by_peer[best]))
            cells.append(f"{sizes[-1]:.3f} ({best}, {len(by_peer[best])})")
        best_rows.append(cells)
    best_rows.append(["geometric mean", *(f"{geometric(sizes):.3f}" if sizes else "" for sizes in against.values())])
    over = [[m, f"{geometric(sizes):.3f}", str(len(sizes))] for m, sizes in relative.items() if sizes]
    notes = (
        f"alpha = {ALPHA}. The first target of every table, {MAX_ROWS} rows of it drawn at random with every seed (all "
        "rows of smaller tables): 60 % training, 20 % calibration, 20 % test, so samples are exchangeable. Mean ± half of "
        "the 95 % interval over splits, as many as the column `in band` counts. "
        "Size: mean length in standard deviations of the training values. A target with fewer distinct "
        "values than a fifth of its rows is on a grid: its size counts the grid values held, each as wide as its cell, "
        "for every method alike. In brackets the exact 99 % Beta-binomial band of one split's coverage; then how many "
        "splits lie in it. Hardest quarter: of the test rows, by residuals that forests expect, the same rows for all. "
        "Excess risk: Brier score of the nominal coverage less that of a cross-fitted classifier that predicts from the "
        "inputs whether a set holds; above 0: predictable. "
        "Seconds are of one core and include tuning. Valid: no run below its 99.99 % band; failed ones do not count. "
        "What each peer is and how it is tuned: `benchmarks/peers/methods.py`; those without a row have no run yet."
    )
    names = ("mapie", "torchcp", "crepes", "R2CCP", "quantile-forest", "ngboost", "scikit-learn")
    write_page(
        "peers",
        "Sets of conformodal and its peers",
        "python benchmarks/peers/run.py --measure",
        notes,
        "## Size over the best valid peer's",
        "On the splits that both have: the ratio, the peer for which it is largest, the number of splits.",
        table_lines(["data", OURS, STACK], best_rows),
        "## Size over the default learner's, geometric mean over the data sets",
        table_lines(["method", "ratio", "data sets"], over),
        "## All",
        table_lines(["data", "method", "coverage", "in band", *SHOWN, "failed"], rows),
        "Versions: " + ", ".join(f"{n} {version(n)}" for n in names) + ".",
    )


if __name__ == "__main__":
    main()
