"""Very many scores and probabilities through calibration and sets: seconds, memory, and whether ranks are exact.

python benchmarks/large.py [--scores 100000000] [--samples 10000000]

Each row is a process of its own. Files are written to a temporary folder: 1.2 GB, and 2 GB of Arrow batches.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from common import write_page
from stream_row import peak_mb

from conformodal.conformal import QuantileBins, SplitConformal, conformal_quantile, conformal_rank

ALPHA, D, K = 0.1, 7, 50
ROWS = 100_000  # of a batch
FAMILY = 1 << 14  # different softmaxes
Numbers = dict[str, Any]


def anonymous_mb() -> float:
    """Memory of the process that no file stands behind."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1e3


def watched(work: Callable[[], Numbers]) -> Numbers:
    """What `work` finds, and what it took: seconds of all cores, and how much anonymous memory it added at most."""
    before = most = anonymous_mb()
    done = threading.Event()

    def look() -> None:
        nonlocal most
        while not done.wait(0.005):
            most = max(most, anonymous_mb())

    watcher = threading.Thread(target=look)
    watcher.start()
    started, cpu = time.perf_counter(), time.process_time()
    found = work()
    took = {"seconds": time.perf_counter() - started, "cpu_s": time.process_time() - cpu}
    done.set()
    watcher.join()
    return {**found, **took, "added_mb": most - before, "resident_mb": peak_mb()}


def write_scores(path: Path, n: int, dtype: str) -> None:
    """Scores of both signs, a tenth of them tied, one in ten thousand infinite."""
    file, rng = np.memmap(path, dtype=dtype, mode="w+", shape=(n,)), np.random.default_rng(0)
    for start in range(0, n, 1 << 20):
        part = file[start : start + (1 << 20)]
        values = rng.standard_normal(part.size, dtype=np.float32)
        values[::10] = np.round(values[::10], 1)
        values[::10_000] = np.inf
        part[:] = values
    file.flush()


def rank_scores(path: Path, dtype: str, how: str) -> Numbers:
    """The conformal quantile of a file, by the library, or by NumPy's partition of the whole."""
    file = np.memmap(path, dtype=dtype, mode="r")
    k = conformal_rank(file.size, ALPHA)

    def work() -> Numbers:
        found = conformal_quantile(file, ALPHA) if how == "ours" else np.partition(file, k - 1)[k - 1]
        return {"found": float(found)}

    numbers = watched(work)
    below = at_most = 0
    for start in range(0, file.size, 1 << 20):  # what the k-th smallest is, counted
        part = file[start : start + (1 << 20)]
        below += int((part < numbers["found"]).sum())
        at_most += int((part <= numbers["found"]).sum())
    return {**numbers, "k": k, "below": below, "at_most": at_most, "exact": below < k <= at_most}


def batches(n: int, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Probabilities (rows, 7, 50) with one or two modes, and values drawn from them; the same for the same seed."""
    rng = np.random.default_rng(1)
    centres, widths = rng.uniform(0, K, (FAMILY, 2, 1)), rng.uniform(1, 4, (FAMILY, 2, 1))
    share = rng.uniform(0, 1, (FAMILY, 1))
    modes = np.exp(-0.5 * ((np.arange(K) - centres) / widths) ** 2)
    family = modes[:, 0] * share + modes[:, 1] * (1 - share) + 1e-6
    family = (family / family.sum(axis=1, keepdims=True)).astype(np.float32)
    reached = np.cumsum(family, axis=1)
    rng = np.random.default_rng(seed)
    for start in range(0, n, ROWS):
        which = rng.integers(0, FAMILY, (min(ROWS, n - start), D))
        drawn = rng.random(which.shape, dtype=np.float32)
        code = (reached[which] < drawn[..., None]).sum(axis=2).clip(0, K - 1)
        yield family[which], (code + rng.random(which.shape)) / K


def calibrator() -> SplitConformal:
    return SplitConformal(QuantileBins.from_edges([np.linspace(0, 1, K + 1)] * D), ALPHA, "density")


def sets_of(n: int, folder: Path) -> Numbers:
    """All samples through calibration, and as many new ones through sets, membership and Arrow, batch by batch."""
    cal, spent = calibrator(), {"calibration": 0.0, "sets and membership": 0.0, "Arrow": 0.0}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        started = time.process_time()
        found = work()
        spent[name] += time.process_time() - started
        return found

    def work() -> Numbers:
        scores = np.empty((n, D), dtype=np.float32)
        for k, (proba, y) in enumerate(batches(n, seed=10)):
            scores[k * ROWS : k * ROWS + len(y)] = timed("calibration", lambda p=proba, y=y: cal.score_samples(p, y))
        timed("calibration", lambda: cal.calibrate_scores(scores))
        held, path, writer = np.zeros(D, dtype=np.int64), folder / "regions.arrow", None
        for proba, y in batches(n, seed=11):
            regions = timed("sets and membership", lambda p=proba: cal.predict(p))
            held += timed("sets and membership", lambda r=regions, y=y: r.contains(y).sum(axis=0))
            table = timed("Arrow", regions.to_arrow)
            writer = writer or pa.ipc.new_file(path, table.schema)
            timed("Arrow", lambda t=table, w=writer: w.write_table(t))
        assert writer is not None
        writer.close()
        below = [int((scores[:, j] < q).sum()) for j, q in enumerate(cal.thresholds_)]
        at_most = [int((scores[:, j] <= q).sum()) for j, q in enumerate(cal.thresholds_)]
        exact = all(b < cal.rank <= a for b, a in zip(below, at_most, strict=True))
        with pa.memory_map(str(path)) as source:
            n_rows = sum(pa.ipc.open_file(source).get_batch(i).num_rows for i in range(-(-n // ROWS)))
        return {"exact": exact and n_rows == n, "k": cal.rank, "held": (held / n).tolist(), "spent": spent}

    numbers = watched(work)
    return {**numbers, "arrow_mb": (folder / "regions.arrow").stat().st_size / 1e6}


def row(*asked: Any) -> Numbers:
    """The numbers of one row, from a process of its own."""
    command = [sys.executable, __file__, "--row", json.dumps(asked)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: Numbers = json.loads(done.stdout.splitlines()[-1])
    print(asked, found, flush=True)
    return found


def answer(asked: list[Any]) -> None:
    if asked[0] == "scores":
        print(json.dumps(rank_scores(Path(asked[1]), asked[2], asked[3])))
    else:
        print(json.dumps(sets_of(asked[1], Path(asked[2]))))


def said(what: str, size: str, numbers: Numbers) -> str:
    exact = "yes" if numbers["exact"] else "NO"
    return (
        f"| {what} | {size} | {numbers['cpu_s']:.1f} | {numbers['added_mb']:.0f} | {numbers['resident_mb']:.0f} | "
        f"{numbers['k']:,} | {exact} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scores", type=int, default=100_000_000)
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--row", type=json.loads, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.row:
        answer(asked.row)
        return
    lines = [
        "| what | size | seconds of one core | memory added, MB | resident, MB | rank k | exact |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    with tempfile.TemporaryDirectory() as scratch:
        for dtype in ("float32", "float64"):
            path, size = Path(scratch) / f"scores.{dtype}", f"{asked.scores:,} {dtype}"
            write_scores(path, asked.scores, dtype)
            lines.append(said("`conformal_quantile` of a mapped file", size, row("scores", str(path), dtype, "ours")))
            numbers = row("scores", str(path), dtype, "partition")
            lines.append(said("`np.partition` of the same file", size, numbers))
            path.unlink()
        numbers = row("sets", asked.samples, scratch)
    size = f"{asked.samples:,} x {D} x {K} float32, {4e-9 * asked.samples * D * K:.1f} GB"
    lines.append(said("calibration; then sets, membership and Arrow of as many more", size, numbers))
    spent = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in numbers["spent"].items())
    low, high = min(numbers["held"]), max(numbers["held"])
    lines += [
        "",
        f"alpha = {ALPHA}. Scores: a memory-mapped file, a tenth of them tied, one in ten thousand infinite. Exact: "
        "fewer than k scores are smaller than the threshold and at least k are at most as large, counted block by "
        "block. Memory added: the most that the process held beyond what it began with, without the pages of mapped "
        "files, which the system takes back when it needs them; resident: with them and all imports.",
        "",
        f"Probabilities come in batches of {ROWS:,} from a seeded generator, whose time is in the row's, twice. "
        "`score_samples` batch by batch, `calibrate_scores` once, then `predict`, `contains` and `to_arrow` batch by "
        f"batch into one Arrow file of {numbers['arrow_mb']:,.0f} MB: {spent}. What grows with the samples is their "
        f"scores, {4e-6 * asked.samples * D:,.0f} MB. Of the new samples' values {low:.5f} to {high:.5f} lie in their "
        "sets, target by target.",
    ]
    write_page("large", "Very many samples", "python benchmarks/large.py", lines)


if __name__ == "__main__":
    main()
