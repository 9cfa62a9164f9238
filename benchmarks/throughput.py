"""Time and memory of sets and membership for many samples, beside reading the probabilities once, and beside peers.

python benchmarks/throughput.py

One run holds about 2.5 GB. crepes and TorchCP are measured where benchmarks/peers/requirements.txt is installed.
"""

from __future__ import annotations

import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import spread, write_table

from conformodal.conformal import QuantileBins, SplitConformal

N, D, K, REPEATS = 1_000_000, 7, 50, 7
PEER_ROWS = 100_000


def seconds(work: Callable[[], Any]) -> list[float]:
    """Times of several runs, after one that warms up."""
    work()
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return found


def problem(n: int, d: int, k: int) -> tuple[Any, ...]:
    rng = np.random.default_rng(0)
    proba = rng.random((n, d, k), dtype=np.float32)
    proba /= proba.sum(axis=2, keepdims=True)
    bins = QuantileBins(k).fit(rng.normal(size=(5000, d)))
    y = rng.normal(size=(n, d)).clip(-3, 3)
    return proba, y, bins


def ours(proba: Any, y: Any, bins: QuantileBins, score: str) -> SplitConformal:
    return SplitConformal(bins, 0.1, score).calibrate(proba[:2000], y[:2000])


def peers(proba: Any, y: Any) -> dict[str, list[float]]:
    """Seconds per run of peers on ``PEER_ROWS`` samples of one target."""
    found = {}
    rows, truth = proba[:PEER_ROWS, 0], y[:PEER_ROWS, 0]
    try:
        import crepes  # noqa: PLC0415

        regressor = crepes.ConformalRegressor().fit(np.abs(truth[:2000]))
        center = rows @ np.linspace(-3, 3, K)

        def intervals() -> Any:
            ends = regressor.predict_int(center, confidence=0.9)
            return (ends[:, 0] <= truth) & (truth <= ends[:, 1])

        found["crepes, one interval"] = seconds(intervals)
    except ImportError:
        pass
    try:
        sys.path.insert(0, str(Path(__file__).with_name("peers")))
        import torch  # noqa: PLC0415
        from methods import _import_torchcp_regression  # noqa: PLC0415

        regression = _import_torchcp_regression()
        score = regression.R2CCP(torch.linspace(-3, 3, K))
        table = torch.from_numpy(np.ascontiguousarray(rows))
        values = torch.from_numpy(truth.astype(np.float32))

        def sets() -> Any:
            ends = score.generate_intervals(table, torch.tensor([-0.02]))
            return ((ends[:, ::2] <= values[:, None]) & (values[:, None] <= ends[:, 1::2])).any(dim=1)

        found["TorchCP R2CCP, intervals"] = seconds(sets)
    except ImportError:
        pass
    return found


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
    share = PEER_ROWS / (N * D)
    for name, found in peers(proba, y).items():
        relative = np.median(found) / share / base
        shape = f"{PEER_ROWS:,} x 1 x {K}"
        rows.append([name, shape, spread(found, 4), f"{relative:.1f}, scaled to {N:,} x {D}", ""])
    notes = (
        "float32 probabilities, alpha 0.1; they are checked (NaN, sign, row sums) on the way. Seconds: median (range) "
        f"of {REPEATS} runs after a warm-up. Memory: input and peak of what is allocated, relative to the input (bool "
        "masks are a quarter of float32). crepes makes one interval a sample and reads no bins; its row says what the "
        "simplest answer costs."
    )
    header = ["what", "samples x targets x bins", "seconds", "relative to reading once", "memory"]
    write_table(
        "throughput", "Sets and membership, time and memory", "python benchmarks/throughput.py", header, rows, notes
    )


if __name__ == "__main__":
    main()
