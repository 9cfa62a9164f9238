"""What the settings of belief and filter were chosen by: errors with other values over errors with the present ones.

python benchmarks/choices.py [--seeds 20 21] [--places ...] [--runs FOLDER] [--workers 2]

Seeds 20 and 21 served to choose by; models are those of benchmarks/ablation.py, cached in the folder of runs.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import numpy as np
from ablation import ALL, EVERY, Frames, Models, Paths
from common import ROOT, write_table
from joblib import Parallel, delayed

from conformodal.localizer.settings import BELIEF, CANDIDATES, FILTER

PLACES = ("redkitchen, interleaved", "redkitchen, blocks", "corridor")
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
READERS = {
    "CANDIDATES": ("reasoning.candidates", "localization.fusion"),
    "FILTER": ("reasoning.filter", "reasoning.prior"),
    "BELIEF": ("localization.fusion",),
}


@contextmanager
def setting(name: str, attribute: str, value: float) -> Iterator[None]:
    """One setting has another value."""
    with ExitStack() as stack:
        for reader in READERS[name]:
            module = importlib.import_module(f"conformodal.{reader}")
            stack.enter_context(patch.object(module, name, replace(PRESENT[name], **{attribute: value})))
        yield


def ratios(place: str, seed: int, runs: Path) -> dict[str, list[list[float]]]:
    """By setting and value: ratios of position and orientation error, one row per interval."""
    models = Models(place, seed, runs)
    ours = models.ours
    found: dict[str, list[list[float]]] = {}
    for interval in EVERY.values():
        seen = Frames(models.sequence, ours.model.split.test, interval)
        present = seen.error(Paths(ours, seen).path(ALL))
        for (name, attribute), values in OTHERS.items():
            for value in values:
                with setting(name, attribute, value):
                    other = seen.error(Paths(ours, seen).path(ALL))
                ratio = [a / b for a, b in zip(other, present, strict=True)]
                found.setdefault(f"{attribute} {value:g}", []).append(ratio)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[20, 21])
    parser.add_argument("--places", nargs="+", choices=PLACES, default=list(PLACES))
    parser.add_argument("--runs", type=Path, default=ROOT / "ablation-out")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    jobs = [delayed(ratios)(place, seed, asked.runs) for place in asked.places for seed in asked.seeds]
    found = iter(Parallel(asked.workers)(jobs))
    of = {place: [next(found) for _ in asked.seeds] for place in asked.places}
    rows = []
    for (name, attribute), values in OTHERS.items():
        for value in values:
            row = [attribute, f"{getattr(PRESENT[name], attribute):g}", f"{value:g}"]
            for place in asked.places:
                logs = np.log([one[f"{attribute} {value:g}"] for one in of[place]]).mean(axis=0)
                row += [f"{position:.2f} / {angle:.2f}" for position, angle in np.exp(logs)]
            rows.append(row)
    header = ["setting", "present", "other", *(f"{place}, {every}" for place in asked.places for every in EVERY)]
    note = (
        f"Ratio of position errors / of orientation errors, geometric means over seeds {asked.seeds}; above 1 the "
        "present value is the better one. Models, frames, intervals as in ablation.md; frames calibrate in both splits."
    )
    line = f"python benchmarks/choices.py --seeds {' '.join(map(str, asked.seeds))}"
    if asked.places != list(PLACES):
        line += f" --places {' '.join(map(shlex.quote, asked.places))}"
    write_table("choices", "Settings of belief and filter", line, header, rows, note)


if __name__ == "__main__":
    main()
