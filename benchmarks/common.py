"""What the benchmarks share: where data lies, models, paths, numbers that are kept, tables and figures."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_predict

from conformodal.geometry import RelativeMotion
from conformodal.io import Recording
from conformodal.localizer.filter import filter_posteriors, hindsight_posteriors
from conformodal.localizer.observations import MotionPrior, Observations, PosePath, choose_places
from conformodal.pipeline.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("CONFORMODAL_DATA", ROOT.parent / "shared" / "data"))
REDKITCHEN = DATA / "7scenes" / "redkitchen" / "seq-01"
RESULTS = Path(__file__).parent / "results"
sys.path.insert(0, str(ROOT))  # the package experiments
SEEDS = (40, 41, 42)  # settings were chosen on 10 to 29; 30 to 34 have been looked at
MIN_MISSED = 10  # rows that a classifier of misses needs
UNLIMITED = 1e6  # radians and metres per second


def source_digest() -> str:
    """Of what decides the numbers: the package, the benchmarks and the experiments."""
    files = sorted(path for name in ("src", "benchmarks", "experiments") for path in (ROOT / name).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


# Models and numbers, by the source that made them. results.py passes its folder on to the scripts that it starts
RUNS = Path(os.environ.get("CONFORMODAL_RUNS", ROOT / "results-out" / source_digest()))


def half_width(values: list[float]) -> float:
    """Half of the 95 % interval of a mean, by Student's t; NaN of one value."""
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)) if len(values) > 1 else float("nan")


def mean_interval(values: list[float], digits: int = 4) -> str:
    """Mean of a few repeats and its 95 % interval; nothing of none."""
    if not values:
        return ""
    half = half_width(values)
    return f"{np.mean(values):.{digits}f}" + ("" if np.isnan(half) else f" ± {half:.{digits}f}")


def rmse(errors: npt.ArrayLike) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def excess_risk(X: npt.ArrayLike, held: npt.ArrayLike, alpha: float) -> float | None:
    """Brier score of the nominal coverage less that of a cross-fitted classifier that sees X (n, p).

    None where too few rows are missed, or held, to learn from.
    """
    held = np.asarray(held, dtype=int)
    if np.bincount(held, minlength=2).min() < MIN_MISSED:
        return None
    folds = StratifiedKFold(5, shuffle=True, random_state=0)
    classifier = HistGradientBoostingClassifier(max_iter=50, max_leaf_nodes=8, random_state=0)
    predicted = cross_val_predict(classifier, np.asarray(X), held, cv=folds, method="predict_proba")[:, 1]
    return float(np.mean((1 - alpha - held) ** 2 - (predicted - held) ** 2))


def parser_of(docstring: str | None) -> argparse.ArgumentParser:
    """A parser of the command line whose help is a script's docstring."""
    return argparse.ArgumentParser(description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter)


def parser_with_seeds(docstring: str | None, seeds: tuple[int, ...] = SEEDS) -> argparse.ArgumentParser:
    """The same with an option for seeds."""
    parser = parser_of(docstring)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(seeds))
    return parser


def cached_json(file: Path, measure: Callable[[], Any]) -> Any:
    """The numbers in a file; measured, and written at once, where it does not exist."""
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_text(json.dumps(measure(), indent=1) + "\n", encoding="utf-8")
        part.replace(file)
    return json.loads(file.read_text(encoding="utf-8"))


def part_of(sequence: Recording, frames: npt.NDArray[np.int64], **changes: Any) -> Recording:
    """Some frames of a recording, with other changes."""
    return replace(
        sequence,
        image_paths=tuple(sequence.image_paths[i] for i in frames.tolist()),
        timestamps_s=sequence.timestamps_s[frames],
        recording=sequence.recording[frames],
        poses=None if sequence.truth is None else sequence.truth[frames],
        given_test=None,
        **changes,
    )


def without_limits(prior: MotionPrior) -> MotionPrior:
    """A motion prior that allows any speed and any turning rate."""
    speeds = tuple(UNLIMITED for _ in prior.top_speed_mps)
    return replace(prior, turn_rate_rad_s=UNLIMITED, top_speed_mps=speeds)


def without_rotations(observed: Observations) -> Observations:
    """Observations whose relative rotations are not known; submaps, which rest on them, are left out too."""

    def unturned(motion: RelativeMotion | None) -> RelativeMotion | None:
        return None if motion is None else replace(motion, R_prev_next=None, rotation_sigma_rad=np.inf)

    return replace(observed, motions=[unturned(motion) for motion in observed.motions], submaps=())


def filtered_path(observed: Observations, prior: MotionPrior, *, hindsight: bool = True) -> PosePath:
    """The most probable places given all frames, or the frames up to each."""
    posteriors = (hindsight_posteriors if hindsight else filter_posteriors)(observed, prior)
    return choose_places(posteriors, observed.timestamps_s, prior)


def table_lines(header: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    return [f"| {' | '.join(cells)} |" for cells in (header, ["---"] * len(header), *rows)]


def write_table(name: str, title: str, command: str, header: list[str], rows: list[list[str]], notes: str = "") -> None:
    """Print a Markdown table and keep it under ``benchmarks/results``, with what made it."""
    write_page(name, title, command, table_lines(header, rows), *([notes] if notes else []))


def write_page(name: str, title: str, command: str, *blocks: str | list[str]) -> None:
    """Print a Markdown page and keep it likewise; a block is a paragraph, or the lines of a table or a list."""
    made = provenance()
    packages = ", ".join(f"{k} {v}" for k, v in made["packages"].items())
    source = (
        f"{date.today()}, source {made['source_revision']}, {platform.machine()} with {os.cpu_count()} cores, "
        f"Python {made['python']}, {packages}."
    )
    parts = [f"# {title}", f"`{command}`", *blocks, source]
    page = "\n\n".join(part if isinstance(part, str) else "\n".join(part) for part in parts) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(page, encoding="utf-8")
    print(page)


def new_axes(name: str, size: tuple[float, float], rows: int = 1) -> Any:
    """A figure and its axes, drawn the same way each time."""
    import matplotlib as mpl  # noqa: PLC0415 - only scripts that draw need it

    mpl.use("Agg")
    mpl.rcParams.update({"svg.hashsalt": name, "svg.fonttype": "none", "font.size": 9})
    from matplotlib import pyplot as plt  # noqa: PLC0415

    return plt.subplots(rows, 1, figsize=size, sharex=True, layout="constrained")


def save_picture(figure: Any, name: str) -> None:
    """Keep a figure among the pictures of the documentation."""
    figure.savefig(ROOT / "docs" / "images" / f"{name}.svg", metadata={"Date": None})
