"""What the benchmarks share: where data lies, running a command, writing a table."""

from __future__ import annotations

import csv
import os
import platform
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import stats

from conformodal.datasets import Sequence
from conformodal.poses import RelativeMotion, Trajectory
from conformodal.reasoning.prior import MotionPrior
from conformodal.running.results.provenance import provenance

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("CONFORMODAL_DATA", ROOT.parent / "shared" / "data"))
RESULTS = Path(__file__).parent / "results"
sys.path.insert(0, str(ROOT))  # the package experiments
UNLIMITED = 1e6  # radians and metres a second


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


def colmap_truth(kitchen: Sequence) -> tuple[npt.NDArray[np.int64], Trajectory]:
    """The frames of redkitchen that COLMAP has poses of (Brachmann et al., ICCV 2021), and these, in its own world."""
    with (DATA / "recordings" / "truth" / "sfm" / "redkitchen_seq-01.csv").open(encoding="utf-8") as file:
        rows = {
            row["frame"]: [float(row[k]) for k in ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")]
            for row in csv.DictReader(file)
        }
    names = [path.name.split(".")[0] for path in kitchen.image_paths]
    frames = np.array([i for i, name in enumerate(names) if name in rows])
    poses = np.array([rows[names[i]] for i in frames])
    return frames, Trajectory(kitchen.timestamps_s[frames], poses[:, :3], poses[:, 3:])


def without_limits(prior: MotionPrior) -> MotionPrior:
    """A motion prior that allows any speed and any turning rate."""
    speeds = tuple(UNLIMITED for _ in prior.top_speed_mps)
    return replace(prior, turn_rate_rad_s=UNLIMITED, top_speed_mps=speeds)


def without_rotation(motion: RelativeMotion | None) -> RelativeMotion | None:
    """A relative motion of which the rotation is not known."""
    return None if motion is None else replace(motion, R_prev_next=None, rotation_sigma_rad=np.inf)


def write_table(name: str, title: str, command: str, header: list[str], rows: list[list[str]], notes: str = "") -> None:
    """Print a Markdown table and keep it under ``benchmarks/results``, with what made it."""
    lines = [f"| {' | '.join(header)} |", f"| {' | '.join('---' for _ in header)} |"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
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
