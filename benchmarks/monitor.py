"""Monitoring: false alarms of exchangeable scores, and how soon a shift is found.

python benchmarks/monitor.py [--sequences 10000]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from common import parser_of, write_table
from joblib import Parallel, delayed
from scipy.stats import beta

from conformodal.conformal import ExchangeabilityMartingale
from conformodal.core.arrays import FloatArray

SEED, LEVEL = 40, 0.01


class Case(NamedTuple):
    """Scores before, and new ones, of which those from `change` on are shifted by so many standard deviations."""

    name: str
    n_before: int
    n_new: int
    change: int
    shift: float
    decimals: int = 16  # fewer make ties


CASES = (
    Case("no shift, 9 recordings before", 9, 100, 0, 0.0),
    Case("no shift, 200 rows before", 200, 400, 0, 0.0),
    Case("no shift, scores of one decimal", 200, 400, 0, 0.0, 1),
    Case("2 sigma at once, 9 recordings before", 9, 100, 0, 2.0),
    Case("1 sigma at once, 20 recordings before", 20, 100, 0, 1.0),
    Case("2 sigma at once, 20 recordings before", 20, 100, 0, 2.0),
    Case("1 sigma after 100, 200 rows before", 200, 400, 100, 1.0),
    Case("0.5 sigma after 100, 200 rows before", 200, 400, 100, 0.5),
)


def alarms(case: Case, larger_only: bool, seeds: range) -> FloatArray:
    """Number of the new score at which each sequence raises an alarm; infinite without one."""
    first = np.full(len(seeds), np.inf)
    for i, seed in enumerate(seeds):
        random = np.random.default_rng((SEED, seed))
        scores = random.normal(size=case.n_before + case.n_new)
        scores[case.n_before + case.change :] += case.shift
        scores = scores.round(case.decimals)
        one = ExchangeabilityMartingale(scores[: case.n_before], level=LEVEL, larger_only=larger_only, seed=seed)
        alarm = one.update(scores[case.n_before :]).alarm_
        first[i] = np.inf if alarm is None else alarm + 1
    return first


def row(case: Case, larger_only: bool, n: int, parallel: Parallel) -> list[str]:
    """Shares of sequences with an alarm, and the delay of the alarms after the change."""
    parts = [range(k, min(k + 500, n)) for k in range(0, n, 500)]
    first = np.concatenate(parallel(delayed(alarms)(case, larger_only, part) for part in parts))
    false, found = int((first <= case.change).sum()), np.isfinite(first) & (first > case.change)
    cells = [case.name, "larger scores" if larger_only else "both sides", str(case.n_new)]
    if not case.shift:
        n_alarms = int(np.isfinite(first).sum())
        low, high = beta.ppf(0.005, n_alarms, n - n_alarms + 1), beta.ppf(0.995, n_alarms + 1, n - n_alarms)
        return [*cells, f"{n_alarms / n:.4f} ({np.nan_to_num(low):.4f} to {high:.4f})", "", ""]
    delay = np.median(first[found] - case.change) if found.any() else np.nan
    return [*cells, f"{false / n:.4f}" if case.change else "", f"{found.mean():.3f}", f"{delay:.0f}"]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=1)
    options, rows = parser.parse_args(), []
    with Parallel(options.workers) as parallel:
        for case in CASES:
            for larger_only in (False, True):
                rows.append(row(case, larger_only, options.sequences, parallel))
                print(rows[-1], flush=True)
    header = ["scores", "bets on", "new scores", "false alarms", "shift found", "scores until then, median"]
    note = (
        f"{options.sequences} sequences of normal scores each, seed {SEED}, level {LEVEL}; the scores before are as "
        "those that calibrate. False alarms: share of sequences with an alarm before any shift, with its 99 % interval "
        "(Clopper and Pearson); the level is an upper bound for sequences of any length. The bets were chosen on seeds "
        "10 and 11."
    )
    command = f"python benchmarks/monitor.py --sequences {options.sequences}"
    write_table("monitor", "Monitoring", command, header, rows, note)


if __name__ == "__main__":
    main()
