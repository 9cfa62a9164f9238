"""What the benchmarks share: where data lies, running a command, writing a table."""

from __future__ import annotations

import os
import platform
from datetime import date
from pathlib import Path

import numpy as np

from conformodal.odometry import provenance

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("CONFORMODAL_DATA", ROOT.parent / "shared" / "data"))
RESULTS = Path(__file__).parent / "results"


def spread(values: list[float], digits: int = 4) -> str:
    """Median and range of a few repeats."""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{np.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


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
