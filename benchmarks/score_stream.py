"""Thresholds of scores that do not fit into memory: seconds, memory, and whether they are those of sorting.

python benchmarks/score_stream.py
"""

from __future__ import annotations

import resource
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from common import write_table

from conformodal.conformal import OnlineConformal, QuantileBins, SplitConformal

ROWS, CHUNK, RATES = (1_000_000, 10_000_000, 100_000_000), 1_000_000, ("0.1", "0.001")
BINS = QuantileBins.from_edges([[0.0, 1.0, 2.0]])


def written(path: Path, n: int) -> None:
    """Scores of a heavy-tailed law in a file, chunk by chunk."""
    file = np.lib.format.open_memmap(path, mode="w+", dtype=np.float64, shape=(n, 1))
    for seed, start in enumerate(range(0, n, CHUNK)):
        file[start : start + CHUNK, 0] = np.random.default_rng(seed).standard_t(3, CHUNK)
    file.flush()


def chunks(path: Path, n: int):
    """Read with plain reads: pages of a mapped file would count as memory of the process."""
    with path.open("rb") as file:
        np.lib.format.read_magic(file)
        np.lib.format.read_array_header_1_0(file)
        for start in range(0, n, CHUNK):
            yield np.fromfile(file, count=min(CHUNK, n - start))[:, None]


def main() -> None:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for n in ROWS:
            path = Path(folder) / "scores.npy"
            written(path, n)
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            source, start = partial(chunks, path, n), time.process_time()
            split = SplitConformal(BINS, RATES[0]).calibrate_scores(source)
            found = [float(split.at(rate).scores_.smallest(split.at(rate).rank)) for rate in RATES]
            seconds = time.process_time() - start
            start = time.process_time()
            online = OnlineConformal(BINS, RATES[0]).begin(source).thresholds[0]
            online_seconds = time.process_time() - start
            peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
            rows.append([f"{n:,}", f"{seconds:.1f}", f"{online_seconds:.1f}", f"{peak:.0f}", found, float(online)])
        # sorted at last, as what it takes would hide what streams take; the largest file is the one still there
        ranked = np.sort(np.load(path)[:, 0])
        ranks = [split.at(rate).rank for rate in RATES]
        exact = rows[-1][4] == [float(ranked[rank - 1]) for rank in ranks] and rows[-1][5] == rows[-1][4][0]
    table = [row[:4] for row in rows]
    header = ["scores", "CPU s, two rates of SplitConformal", "CPU s, OnlineConformal", "more memory, MB"]
    note = (
        "float64 scores of one target (Student's t, 3 degrees of freedom) in a file that is read in chunks of "
        f"{CHUNK:,}; rates {' and '.join(RATES)}. Memory: growth of the peak of the process. "
        f"Thresholds of {ROWS[-1]:,} scores equal those of sorting: {'yes' if exact else 'NO'}."
    )
    write_table(
        "score_stream", "Thresholds of scores from a source", "python benchmarks/score_stream.py", header, table, note
    )


if __name__ == "__main__":
    main()
