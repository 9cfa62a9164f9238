"""Time and memory of sets and membership for many samples, relative to reading the probabilities once.

python benchmarks/throughput.py

One run holds about 2.5 GB.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
from common import seconds_of, spread, write_table

from conformodal.conformal import QuantileBins, SplitConformal

N, D, K, REPEATS = 1_000_000, 7, 50, 7


def seconds(work: Callable[[], Any]) -> list[float]:
    """Times of several runs, after one that warms up."""
    work()
    return [seconds_of(work) for _ in range(REPEATS)]


def problem(n: int, d: int, k: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    proba = rng.random((n, d, k), dtype=np.float32)
    proba /= proba.sum(axis=2, keepdims=True)
    bins = QuantileBins(k).fit(rng.normal(size=(5000, d)))
    y = rng.normal(size=(n, d)).clip(-3, 3)
    return proba, y, bins


def ours(proba: Any, y: Any, bins: QuantileBins, score: str) -> SplitConformal:
    return SplitConformal(bins, 0.1, score).calibrate(proba[:2000], y[:2000])


def main() -> None:
    proba, y, bins = problem(N, D, K)
    read = seconds(proba.sum)
    base = float(np.median(read))
    rows = [["read once (`proba.sum()`)", f"{N:,} x {D} x {K}", spread(read, 3), "1.0", ""]]
    results = {}
    for score in ("density", "lac"):
        cal = ours(proba, y, bins, score)
        regions = cal.predict(proba)
        work = {
            "sets": lambda cal=cal: cal.predict(proba),
            "membership": lambda regions=regions: regions.contains(y),
            "sets and membership": lambda cal=cal: cal.predict(proba).contains(y),
            "interval counts": lambda regions=regions: regions.n_intervals,
            "lengths": lambda regions=regions: regions.length,
        }
        if score == "lac":
            work = {"sets and membership": work["sets and membership"]}
        for name, run in work.items():
            found = seconds(run)
            results[score, name] = float(np.median(found))
            shape = f"{N:,} x {D} x {K}"
            rows.append([f"{name}, {score}", shape, spread(found, 3), f"{np.median(found) / base:.1f}", ""])
    cal = ours(proba, y, bins, "density")
    tracemalloc.start()
    cal.predict(proba).contains(y)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    rows[3][-1] = f"{1 + peak / proba.nbytes:.2f}"
    for n, d, k in ((N // 2, D, K), (N, D, K // 2)):
        part, values, fewer = problem(n, d, k)
        cal = ours(part, values, fewer, "density")
        found = seconds(lambda cal=cal, part=part, values=values: cal.predict(part).contains(values))
        ratio = float(np.median(found)) / results["density", "sets and membership"]
        shape = f"{n:,} x {d} x {k}"
        rows.append(["sets and membership, density", shape, spread(found, 3), f"{ratio:.2f} of the whole", ""])
        del part
    notes = (
        "float32 probabilities, alpha 0.1; they are checked (NaN, sign, row sums) on the way. Seconds: median (range) "
        f"of {REPEATS} runs after a warm-up. Memory: input and peak of what is allocated, relative to the input (bool "
        "masks are a quarter of float32)."
    )
    header = ["what", "samples x targets x bins", "seconds", "relative to reading once", "memory"]
    write_table(
        "throughput", "Sets and membership, time and memory", "python benchmarks/throughput.py", header, rows, notes
    )


if __name__ == "__main__":
    main()
