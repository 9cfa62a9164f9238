"""Ranks of every path that computes a threshold, against rational arithmetic: all n to 2000, all rates in thousandths.

python benchmarks/exact_ranks.py
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from common import write_table

from conformodal.conformal import conformal_quantile, conformal_rank
from conformodal.conformal.calibration.weighted import WeightedRanks
from conformodal.conformal.online.trackers import PastScores

LARGEST = 2000


def main() -> None:
    alphas = [Fraction(a, 1000) for a in range(1, 1000)]
    floats = np.arange(1, 1000) / 1000
    missed = dict.fromkeys(
        (
            "`conformal_rank`, rates as floats",
            "`conformal_quantile` (split, Mondrian, joint)",
            "weighted, equal weights of 0.1",
            "online, past scores",
            "float formula: `ceil((n + 1) * (1 - alpha))`",
            "float formula: the same as a level of `np.quantile(..., method='inverted_cdf')`",
            "float formula: the same as a level of `np.quantile(..., method='higher')`",
        ),
        0,
    )
    names = list(missed)
    past = PastScores()
    for n in range(1, LARGEST + 1):
        past.add(float(n))
        scores = np.arange(1, n + 1, dtype=float)
        weights = WeightedRanks([0.1] * n, [0.1])
        exact = np.array([-(-(n + 1) * (1000 - a) // 1000) for a in range(1, 1000)])
        limit = np.where(exact <= n, exact, np.inf)
        found = (
            [conformal_rank(n, float(a)) for a in floats],
            [conformal_quantile(scores, a) for a in alphas],
            [weights.at(a)[0] for a in alphas],
            [past.threshold(a) for a in alphas],
            np.ceil((n + 1) * (1 - floats)),
        )
        for name, each, expected in zip(names, found, (exact, limit, exact, limit, exact), strict=False):
            missed[name] += int(np.sum(np.asarray(each) != expected))
        level = np.ceil((n + 1) * (1 - floats)) / n
        fits = level <= 1
        for name, method in ((names[-2], "inverted_cdf"), (names[-1], "higher")):
            by_quantile = np.full(999, np.inf)
            by_quantile[fits] = np.quantile(scores, level[fits], method=method)
            missed[name] += int(np.sum(by_quantile != limit))
    cases = LARGEST * 999
    rows = [[name, str(count), f"{cases:,}"] for name, count in missed.items()]
    notes = (
        "The last three are what is often written instead; `higher` takes the next larger score. Every calibrator is "
        "tested where floats miss in `tests/`."
    )
    header = ["path", "mismatches", "cases"]
    write_table(
        "exact_ranks", "Ranks against rational arithmetic", "python benchmarks/exact_ranks.py", header, rows, notes
    )


if __name__ == "__main__":
    main()
