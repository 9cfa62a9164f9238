"""The page of a recording: a plan of it by how well it is covered, and what to record next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import rows_by_label
from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.settings import QUALITY

from .page import render_page

with require_extra("figures", "the page of a recording"):
    from matplotlib.figure import Figure

    from .figures import as_svg

# Colours of Okabe and Ito; every kind has a mark of its own too, so that the plan is read without colour.
GOOD, SPARSE, FAST, AMBIGUOUS, KNOWN = "#0072B2", "#D55E00", "#E69F00", "#CC79A7", "#888888"
PLAN = "plan.svg"
_LONGEST, _SHORTEST = 8.5, 3.2  # inches of the plan


def quality_plan(found: RecordingQuality) -> str | None:
    """The recording seen along the axis that it spreads least along, as SVG text; None where it has no poses."""
    if found.poses is None or found.coverage is None:
        return None
    axes = found.axes
    flat = found.poses.positions_xyz[:, axes]
    width, height = np.maximum(np.ptp(flat, axis=0), 1e-6)
    tall = float(np.clip(_LONGEST * height / width, _SHORTEST, _LONGEST))
    figure = Figure(figsize=(10, tall + 1.2), layout="constrained")
    axis = figure.subplots()
    for own in rows_by_label(found.sequence.recording[found.posed]):
        axis.plot(*flat[own].T, "-", lw=1, color=KNOWN, alpha=0.6, zorder=1)
    axis.annotate("start", flat[0], xytext=(-6, -14), textcoords="offset points", fontsize="small", zorder=6)
    sparse, ambiguous = found.coverage.sparse_frames, np.zeros(len(flat), dtype=np.bool_)
    if found.ambiguity is not None:
        ambiguous = np.isin(found.posed, found.ambiguity.frames[found.ambiguity.n_places > 1])
    good = ~sparse & ~ambiguous
    axis.plot(*flat[good].T, ".", ms=5, color=GOOD, label=f"well covered ({good.sum()} frames)", zorder=2)
    if ambiguous.any():
        label = f"ambiguous: looks like another place ({ambiguous.sum()})"
        axis.plot(*flat[ambiguous].T, "s", ms=9, mfc="none", mew=1.4, color=AMBIGUOUS, label=label, zorder=3)
    if sparse.any():
        label = f"sparsely covered ({sparse.sum()})"
        axis.plot(*flat[sparse].T, "x", ms=6, mew=1.6, color=SPARSE, label=label, zorder=4)
    for number, one in enumerate(found.coverage.fast):
        what = f"fast motion ({len(found.coverage.fast)})" if number == 0 else None
        rows = (found.posed >= one.first) & (found.posed <= one.last)
        axis.plot(*flat[rows].T, "--", lw=2, color=FAST, label=what, zorder=1.5)
    for one in found.coverage.sparse:
        axis.annotate(
            f"{one.first}-{one.last}",
            np.array(one.place_xyz)[list(axes)].tolist(),
            xytext=(8, 8),
            textcoords="offset points",
            fontsize="small",
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": SPARSE, "lw": 0.8, "alpha": 0.85},
            zorder=6,
        )
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.08)
    axis.set_xlabel(f"{'xyz'[axes[0]]} (m)")
    axis.set_ylabel(f"{'xyz'[axes[1]]} (m)")
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return as_svg(figure)


def write_quality_page(folder: Path, found: RecordingQuality, record: dict[str, Any], findings: list[str]) -> None:
    """Write ``report.html`` and ``figures/plan.svg`` from the content of ``metrics.json`` and a line per finding."""
    plan = quality_plan(found)
    if plan is not None:
        write_whole(folder / "figures" / PLAN, plan)
    quality = record["quality"]
    rows = [(kind, row) for kind in ("sparse", "fast") for row in quality.get(kind, [])]
    rows += [("ambiguous", row) for row in quality.get("ambiguity", {}).get("stretches", [])]
    render_page(
        folder / "report.html",
        "quality",
        title=f"Is {found.sequence.name} good enough?",
        quality=quality,
        plan=plan,
        rows=sorted(rows, key=lambda row: row[1]["first"]),
        findings=findings,
        made={key: record[key] for key in ("provenance", "configuration")},
        sparse_share=round(100 * QUALITY.sparse),
    )
