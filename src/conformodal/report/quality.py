"""The page of a recording: its plan, what is missing, and what to record next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import BoolArray, rows_by_label
from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.settings import QUALITY

from .page import PAGE, render_page

with require_extra("figures", "the page of a recording"):
    from matplotlib.figure import Figure

    from .figures import as_svg

# Colours of Okabe and Ito; every kind has a mark of its own too, so that the plan is read without colour.
GOOD, SPARSE, FAST, AMBIGUOUS, PATH = "#0072B2", "#D55E00", "#E69F00", "#CC79A7", "#888888"
PLAN = "figures/plan.svg"
_LONGEST, _SHORTEST = 8.5, 3.2  # inches of the plan


def quality_plan(quality: RecordingQuality) -> str | None:
    """The recording seen along the axis that it spreads least along, as SVG text; None where it has no poses."""
    if quality.poses is None or quality.coverage is None:
        return None
    flat = quality.poses.positions_xyz[:, quality.axes]
    width, height = np.maximum(np.ptp(flat, axis=0), 1e-6)
    tall = float(np.clip(_LONGEST * height / width, _SHORTEST, _LONGEST))
    figure = Figure(figsize=(10, tall + 1.2), layout="constrained")
    axis = figure.subplots()
    for rows in rows_by_label(quality.sequence.recording[quality.posed]):
        axis.plot(*flat[rows].T, "-", lw=1, color=PATH, alpha=0.6, zorder=1)
    note: dict[str, Any] = {"textcoords": "offset points", "fontsize": "small", "zorder": 6}
    axis.annotate("start", flat[0], xytext=(-6, -14), **note)
    sparse, ambiguous = quality.coverage.sparse_frames, np.zeros(len(flat), dtype=np.bool_)
    if quality.ambiguity is not None:
        ambiguous = np.isin(quality.posed, quality.ambiguity.frames[quality.ambiguity.n_places > 1])
    marks: list[tuple[BoolArray, str, dict[str, Any]]] = [
        (~sparse & ~ambiguous, "well covered", {"marker": ".", "ms": 5, "color": GOOD}),
        (ambiguous, "ambiguous", {"marker": "s", "ms": 9, "mfc": "none", "mew": 1.4, "color": AMBIGUOUS}),
        (sparse, "sparsely covered", {"marker": "x", "ms": 6, "mew": 1.6, "color": SPARSE}),
    ]
    for chosen, label, style in marks:
        if chosen.any():
            axis.plot(*flat[chosen].T, ls="", label=f"{label} ({chosen.sum()})", zorder=3, **style)
    for number, one in enumerate(quality.coverage.fast):
        name = f"fast motion ({len(quality.coverage.fast)})" if number == 0 else None
        fast = (quality.posed >= one.first) & (quality.posed <= one.last)
        axis.plot(*flat[fast].T, "--", lw=2, color=FAST, label=name, zorder=1.5)
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": SPARSE, "lw": 0.8, "alpha": 0.85}
    for one in quality.coverage.sparse:
        place = np.array(one.place_xyz)[list(quality.axes)].tolist()
        axis.annotate(f"{one.first}-{one.last}", place, xytext=(8, 8), bbox=box, **note)
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.08)
    first, second = (f"{'xyz'[k]} (m)" for k in quality.axes)
    axis.set(xlabel=first, ylabel=second)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return as_svg(figure)


def write_quality_page(
    folder: Path, quality: RecordingQuality | None, record: dict[str, Any], findings: list[str]
) -> None:
    """Write ``report.html`` and ``figures/plan.svg`` from the content of ``metrics.json`` and a line per finding.

    Without findings about the quality, those of an earlier check are removed.
    """
    plan = None if quality is None else quality_plan(quality)
    for name in (PAGE, PLAN):
        (folder / name).unlink(missing_ok=True)
    if plan is not None:
        write_whole(folder / PLAN, plan)
    if quality is not None:
        render_page(
            folder / PAGE,
            "quality",
            title=f"Is {quality.sequence.name} good enough?",
            quality=record["quality"],
            plan=plan,
            findings=findings,
            record=record,
            sparse_share=round(100 * QUALITY.sparse),
        )
