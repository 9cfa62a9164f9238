"""conformodal beside its peers: same process, splits and seeds; alpha = 0.1.

pip install --no-deps -r benchmarks/peers/requirements.txt
python benchmarks/peers/run.py                # everything; finished runs are kept, so it resumes
python benchmarks/peers/run.py concrete bio   # some tables
python benchmarks/peers/run.py --classifiers  # no peers: classifiers as the estimator, beside the default learner
"""

from __future__ import annotations

import argparse
import json
import time
import traceback
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from measure import measure
from methods import CLASSIFIERS, METHODS, OURS, PROBE, STACK
from problems import TABLES, splits

from conformodal.conformal import check_coverage, coverage_band

from common import spread, write_table  # isort: skip - problems puts its folder on the path

ALPHA = 0.1
SEEDS = {"concrete": 2, "bimodal": 2}  # one of the others
Run = dict[str, Any]


def run_all(tables: list[str], store: Path, methods: list[str]) -> None:
    done = {(r["key"], r["method"]) for r in load(store)}
    every = [split for table in tables for split in splits([table], range(SEEDS.get(table, 1)), ALPHA)]
    for split in sorted(every, key=lambda split: split.seed):  # every table once, then again
        for name in methods:
            if (split.key, name) in done:
                continue
            start = time.perf_counter()
            record: Run = {"key": split.key, "table": split.table, "target": split.target, "seed": split.seed}
            record |= {"method": name, "n_cal": len(split.y["cal"]), "n_test": len(split.y["test"])}
            record |= {"optimal": split.optimal_length, "failed": None}
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    sets = METHODS[name](split, ALPHA)
                record |= measure(sets, split.y["test"], split.grid)
                if not np.isfinite(record["size"]):
                    raise ArithmeticError(f"size is {record['size']}")
            except Exception as exc:
                record["failed"] = f"{type(exc).__name__}: {exc}"
                traceback.print_exc()
            record["seconds"] = time.perf_counter() - start
            with store.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
            shown = ("key", "method", "size", "components", "seconds", "failed")
            print({k: record.get(k) for k in shown}, flush=True)


def load(store: Path) -> list[Run]:
    return [json.loads(line) for line in store.read_text().splitlines()] if store.exists() else []


def summarise(runs: list[Run]) -> tuple[list[list[str]], str]:
    rows, ratios, to_default, lines = [], {}, {}, []  # ratios: one a data set, by method
    tables = [t for t in (*TABLES, "bimodal") if any(r["table"] == t for r in runs)]
    for table in tables:
        sizes = {}
        for method in METHODS:
            own = [r for r in runs if r["table"] == table and r["method"] == method]
            if not own:
                continue
            good = [r for r in own if not r["failed"] and r["size"] > 0]
            seeds = sorted({r["seed"] for r in good})
            by_seed = {k: [mean([r[k] for r in good if r["seed"] == s]) for s in seeds] for k, mean in FIELDS.items()}
            if good:
                covered, total = sum(r["covered"] for r in good), sum(r["n_test"] for r in good)
                inside = [in_band(r) for r in good]
                valid = len(good) == len(own) and min(in_band(r, 0.9999) for r in good) >= 0
                if valid and method != PROBE:
                    sizes[method] = float(np.median(by_seed["size"]))
                low, high = band(good)
                share = f"{covered / total:.3f} [{low:.3f}, {high:.3f}]"
                fields = (spread(by_seed[k], digits) for k, digits in (("size", 3), ("components", 2), ("seconds", 0)))
                hits = f"{sum(b == 0 for b in inside)} of {len(good)}"
                rows.append([table, method, share, hits, *fields, str(len(own) - len(good))])
            else:
                rows.append([table, method, "", "", "", "", "", str(len(own))])
        if table == "bimodal":
            best = float(np.median([r["optimal"] for r in runs if r["table"] == table]))
            rows.append([table, "the shortest there can be", "0.900", "", f"{best:.3f}", "", "", ""])
        peers = {m: s for m, s in sizes.items() if m not in (OURS, STACK, *CLASSIFIERS)}
        for method in (m for m in CLASSIFIERS if m in sizes and OURS in sizes):
            to_default.setdefault(method, []).append(sizes[method] / sizes[OURS])
        ours = [m for m in (OURS, STACK) if m in sizes]
        if ours and peers:
            best_peer = min(peers, key=lambda m: peers[m])
            for method in ours:
                ratios.setdefault(method, []).append(sizes[method] / peers[best_peer])
            found = ", ".join(f"{ratios[m][-1]:.3f} ({m})" for m in ours)
            lines.append(f"- {table}: {found} of the best valid peer, {best_peer}.")
    for method, found in ratios.items():
        lines.append(f"\nGeometric mean over the {len(found)} data sets: {geometric(found):.3f} ({method}).")
    for method, found in to_default.items():
        lines.append(f"\n{method}, relative to {OURS}: {geometric(found):.3f} over {len(found)} data sets.")
    return rows, "\n".join(lines)


def geometric(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


# over a table's targets, seed by seed
FIELDS = {"size": geometric, "components": np.mean, "seconds": np.mean}


def in_band(run: Run, level: float = 0.99) -> int:
    inside = np.arange(run["n_test"]) < run["covered"]
    check = check_coverage(inside, run["n_cal"], ALPHA, level)
    return 0 if check.inside else (1 if check.coverage > check.high else -1)


def band(good: list[Run]) -> tuple[float, float]:
    return coverage_band(good[0]["n_cal"], good[0]["n_test"], ALPHA)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", default=[*TABLES, "bimodal"])
    parser.add_argument("--store", type=Path, default=Path(__file__).with_name("runs.jsonl"))
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument(
        "--classifiers", action="store_true", help="the default learner and classifiers, a table of its own"
    )
    parser.add_argument("--no-table", action="store_true", help="run, but leave the committed table as it is")
    args = parser.parse_args()
    methods = [OURS, *CLASSIFIERS] if args.classifiers else args.methods
    run_all(args.tables, args.store, methods)
    if args.no_table:
        return
    rows, ratios = summarise([run for run in load(args.store) if run["method"] in methods])
    names = ("mapie", "torchcp", "crepes", "R2CCP", "quantile-forest", "scikit-learn")
    if args.classifiers:
        names, compared = names[-1:], "Size of the sets relative to those of the default learner, geometric mean"
    else:
        compared = "Size of `conformodal`'s sets relative to the best peer with valid coverage, median over seeds"
    notes = (
        f"{compared}:\n\n{ratios}\n\n"
        "60 % training, 20 % calibration, 20 % test, drawn at random, so samples are exchangeable. Sizes in standard "
        "deviations of the training targets, geometric mean over a table's targets; median (range) over seeds 0 and 1 "
        "for concrete and bimodal, seed 0 alone for the others. A target with fewer distinct values than a fifth of its "
        "rows is on a grid: its size counts the grid values held, each as wide as its cell, for every method alike. In "
        "brackets the exact 99 % Beta-binomial band of one split's coverage; then how many single coverages lie in it. "
        "Valid: no run failed (an error, or every set empty), none below its 99.99 % band. What each peer is and how it "
        "is tuned: `benchmarks/peers/methods.py`. Seconds include tuning; the machine had other work, so they tell orders only.\n\n"
        + "Versions: "
        + ", ".join(f"{n} {version(n)}" for n in names)
        + "."
    )
    header = ["data", "method", "coverage", "in band", "size", "components", "seconds", "failed"]
    command, name, title = "python benchmarks/peers/run.py", "peers", "Sets of conformodal and its peers, alpha = 0.1"
    if args.classifiers:
        command, name, title = f"{command} --classifiers", "classifiers", "Sets with any classifier, alpha = 0.1"
    write_table(name, title, command, header, rows, notes)


if __name__ == "__main__":
    main()
