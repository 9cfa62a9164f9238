"""What the settings of belief and filter were chosen by: errors with other values over errors with the present ones.

python benchmarks/choices.py [--seeds 20 21] [--places ...] [--runs FOLDER] [--workers 2]

Seeds 20 and 21 served to choose by; models are those of benchmarks/ablation.py, cached in the folder of runs.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import numpy as np
from ablation import EVERY, PLACES, Models, observed, smoothed
from common import ROOT, parser_with_seeds, write_table
from joblib import Parallel, delayed

from conformodal.localizer.settings import BELIEF, CANDIDATES, FILTER

# By the settings' object and attribute: other values than the present one.
OTHERS = {
    ("CANDIDATES", "least_mass"): (1e-4, 1e-5),
    ("FILTER", "alike"): (0.0, 0.5, 0.95),
    ("FILTER", "alike_s"): (0.1, 1.0),
    ("FILTER", "wrong_if_unknown"): (0.1, 0.99),
    ("FILTER", "rotation_sigma_factor"): (1.0, 4.0, 8.0),
    ("BELIEF", "agree"): (0.0, 4.0, 16.0, 1e9),
}
PRESENT = {"CANDIDATES": CANDIDATES, "FILTER": FILTER, "BELIEF": BELIEF}


@contextmanager
def setting(name: str, attribute: str, value: float) -> Iterator[None]:
    """One setting has another value, in all modules that read it."""
    with ExitStack() as stack:
        readers = [module for module in list(sys.modules.values()) if getattr(module, name, None) is PRESENT[name]]
        for module in readers:
            stack.enter_context(patch.object(module, name, replace(PRESENT[name], **{attribute: value})))
        yield


def ratios(place: str, seed: int, runs: Path) -> dict[tuple[str, float], list[list[float]]]:
    """By attribute and value: ratios of position and orientation error, one row per interval."""
    models = Models(place, seed, runs)
    model = models.trained()
    by_value: dict[tuple[str, float], list[list[float]]] = {}

    def errors(interval_s: float) -> list[float]:
        run = models.run(model, interval_s)
        return models.error(run, smoothed(observed(run), model.prior))

    for interval_s in EVERY.values():
        present = errors(interval_s)
        for (name, attribute), values in OTHERS.items():
            for value in values:
                with setting(name, attribute, value):
                    ratio = [a / b for a, b in zip(errors(interval_s), present, strict=True)]
                by_value.setdefault((attribute, value), []).append(ratio)
    return by_value


def main() -> None:
    parser = parser_with_seeds(__doc__, (20, 21))
    parser.add_argument("--places", nargs="+", choices=PLACES, default=list(PLACES))
    parser.add_argument("--runs", type=Path, default=ROOT / "ablation-out")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    jobs = [delayed(ratios)(place, seed, options.runs) for place in options.places for seed in options.seeds]
    results = iter(Parallel(options.workers)(jobs))
    by_place = {place: [next(results) for _ in options.seeds] for place in options.places}
    rows = []
    for (name, attribute), values in OTHERS.items():
        for value in values:
            row = [attribute, f"{getattr(PRESENT[name], attribute):g}", f"{value:g}"]
            for place in options.places:
                logs = np.log([each[attribute, value] for each in by_place[place]]).mean(axis=0)
                row += [f"{position:.2f} / {angle:.2f}" for position, angle in np.exp(logs)]
            rows.append(row)
    header = ["setting", "present", "other", *(f"{place}, {every}" for place in options.places for every in EVERY)]
    note = (
        f"Ratio of position errors / of orientation errors, geometric means over seeds {options.seeds}; above 1 the "
        "present value is the better one. Models, frames, intervals as in ablation.md; frames calibrate in both splits."
    )
    write_table("choices", "Settings of belief and filter", shlex.join(["python", *sys.argv]), header, rows, note)


if __name__ == "__main__":
    main()
