"""What the benchmarks share: where data lies, running a command, writing a table."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from conformodal.geometry import RelativeMotion
from conformodal.io import Recording
from conformodal.localizer.prior import MotionPrior
from conformodal.pipeline.results.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("CONFORMODAL_DATA", ROOT.parent / "shared" / "data"))
REDKITCHEN = DATA / "7scenes" / "redkitchen" / "seq-01"
RESULTS = Path(__file__).parent / "results"
sys.path.insert(0, str(ROOT))  # the package experiments
SEEDS = (10, 11, 12, 13, 14)  # no value of a setting was chosen on them; 20 to 22 served to choose by
UNLIMITED = 1e6  # radians and metres per second


def spread(values: list[float], digits: int = 4) -> str:
    """Median and range of a few repeats."""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def half_width(values: list[float]) -> float:
    """Half of the 95 % interval of a mean, by Student's t; NaN of one value."""
    return float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)) if len(values) > 1 else float("nan")


def mean_interval(values: list[float], digits: int = 4) -> str:
    """Mean of a few repeats and its 95 % interval; nothing of none."""
    if not values:
        return ""
    half = half_width(values)
    return f"{np.mean(values):.{digits}f}" + ("" if np.isnan(half) else f" ± {half:.{digits}f}")


def seconds_of(work: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def cached_json(file: Path, measure: Callable[[], Any]) -> Any:
    """The numbers in a file; measured, and written at once, where it does not exist."""
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_text(json.dumps(measure(), indent=1) + "\n", encoding="utf-8")
        part.replace(file)
    return json.loads(file.read_text(encoding="utf-8"))


def train_briefly(sequence: Recording, folder: Path, *sources: str) -> Path:
    """Save a model whose training is short: that does not change how fast it is."""
    from conformodal.features.extract import FeatureCache  # noqa: PLC0415
    from conformodal.features.settings import TrainingConfig  # noqa: PLC0415
    from conformodal.pipeline.config import ModelConfig  # noqa: PLC0415 - torch
    from conformodal.pipeline.store import save_model  # noqa: PLC0415
    from conformodal.pipeline.train import prepare_training_data, train_model  # noqa: PLC0415

    config = ModelConfig(sources=sources or ModelConfig().sources, training=TrainingConfig(epochs=5))
    save_model(train_model(prepare_training_data(sequence, config, FeatureCache(None)), config), folder)
    return folder


def in_process(script: str, asked: object, cores: int) -> dict[str, Any]:
    """The numbers that a script prints in a process of its own, kept to some cores."""
    here = sorted(os.sched_getaffinity(0))[:cores]
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name(script))],
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, here),
        env={**os.environ, "OMP_NUM_THREADS": str(cores), "OPENBLAS_NUM_THREADS": str(cores)},
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def without_limits(prior: MotionPrior) -> MotionPrior:
    """A motion prior that allows any speed and any turning rate."""
    speeds = tuple(UNLIMITED for _ in prior.top_speed_mps)
    return replace(prior, turn_rate_rad_s=UNLIMITED, top_speed_mps=speeds)


def without_rotation(motion: RelativeMotion | None) -> RelativeMotion | None:
    """A relative motion of which the rotation is not known."""
    return None if motion is None else replace(motion, R_prev_next=None, rotation_sigma_rad=np.inf)


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
    written = (
        f"{date.today()}, source {made['source_revision']}, {platform.machine()} with {os.cpu_count()} cores, "
        f"Python {made['python']}, {packages}."
    )
    parts = [f"# {title}", f"`{command}`", *blocks, written]
    page = "\n\n".join(part if isinstance(part, str) else "\n".join(part) for part in parts) + "\n"
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(page, encoding="utf-8")
    print(page)
