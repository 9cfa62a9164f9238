"""What the benchmarks share: where data lies, running a command, writing a table."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from conformodal.poses import RelativeMotion
from conformodal.reasoning.prior import MotionPrior
from conformodal.running.results.provenance import provenance

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
    lines = table_lines(header, rows)
    write_page(name, title, command, [*lines, "", notes] if notes else lines)


def write_page(name: str, title: str, command: str, content: list[str]) -> None:
    """Print Markdown lines and keep them likewise."""
    made = provenance()
    packages = ", ".join(f"{k} {v}" for k, v in made["packages"].items())
    lines = [f"# {title}", "", f"`{command}`", "", *content]
    lines += [
        "",
        f"{date.today()}, source {made['source_revision']}, {platform.machine()} with {os.cpu_count()} cores, "
        f"Python {made['python']}, {packages}.",
        "",
    ]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))
