"""The page of a recording: a plan of it by how well it is covered, and what to record next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.datasets import Sequence
from conformodal.poses import Trajectory, matrix_from_quat_wxyz
from conformodal.quality.advice import names_of
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.settings import QUALITY
from conformodal.quality.view_coverage import SparseStretch

from .templating import render_page

with require_extra("figures", "the page of a recording"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .figures import as_svg

# Colours of Okabe and Ito; every kind has a mark of its own too, so that the plan is read without colour.
GOOD, THIN, FAST, AMBIGUOUS, KNOWN = "#0072B2", "#D55E00", "#E69F00", "#CC79A7", "#888888"
PLAN = "plan.svg"
_LONGEST, _SHORTEST = 8.5, 3.2  # inches of the plan
_ARROW = 0.06  # of the plan's width
_MOST_ARROWS = 3  # in one stretch


def quality_plan(found: RecordingQuality, sequence: Sequence) -> str | None:
    """The recording seen along the axis that it spreads least along, as SVG text; None where it has no poses."""
    if found.poses is None or found.coverage is None:
        return None
    axes = names_of(found, sequence).axes
    flat = found.poses.positions_xyz[:, axes]
    width, height = np.maximum(np.ptp(flat, axis=0), 1e-6)
    tall = float(np.clip(_LONGEST * height / width, _SHORTEST, _LONGEST))
    figure = Figure(figsize=(10, tall + 1.2), layout="constrained")
    axis = figure.subplots()
    recording = sequence.recording[found.posed]
    for number in np.unique(recording):
        axis.plot(*flat[recording == number].T, "-", lw=1, color=KNOWN, alpha=0.6, zorder=1)
    axis.annotate("start", flat[0], xytext=(-6, -14), textcoords="offset points", fontsize="small", zorder=6)
    sparse, ambiguous = found.coverage.sparse_frames, _ambiguous(found)
    good = ~sparse & ~ambiguous
    axis.plot(*flat[good].T, ".", ms=5, color=GOOD, label=f"well covered ({good.sum()} frames)", zorder=2)
    if ambiguous.any():
        label = f"ambiguous: looks like another place ({ambiguous.sum()})"
        axis.plot(*flat[ambiguous].T, "s", ms=9, mfc="none", mew=1.4, color=AMBIGUOUS, label=label, zorder=3)
    if sparse.any():
        label = f"sparsely covered ({sparse.sum()})"
        axis.plot(*flat[sparse].T, "x", ms=6, mew=1.6, color=THIN, label=label, zorder=4)
    _steps(axis, found, flat)
    _stretches(axis, found, axes, _ARROW * max(float(width), float(height)))
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.08)
    axis.set_xlabel(f"{'xyz'[axes[0]]} (m)")
    axis.set_ylabel(f"{'xyz'[axes[1]]} (m)")
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return as_svg(figure)


def write_quality_page(
    folder: Path, found: RecordingQuality, sequence: Sequence, record: dict[str, Any], findings: list[str]
) -> None:
    """Write ``report.html`` and ``figures/plan.svg`` from the content of ``metrics.json`` and a line per finding."""
    plan = quality_plan(found, sequence)
    if plan is not None:
        write_whole(folder / "figures" / PLAN, plan)
    quality = record["quality"]
    rows = [(kind, row) for kind in ("sparse", "fast") for row in quality.get(kind, [])]
    rows += [("ambiguous", row) for row in quality.get("ambiguity", {}).get("stretches", [])]
    render_page(
        folder / "report.html",
        "quality",
        title=f"Is {sequence.name} good enough?",
        quality=quality,
        plan=plan,
        rows=sorted(rows, key=lambda row: row[1]["first"]),
        findings=findings,
        made={key: record[key] for key in ("provenance", "configuration")},
        sparse_share=round(100 * QUALITY.sparse),
    )


def _ambiguous(found: RecordingQuality) -> BoolArray:
    """(n,) whether the region of each frame with a pose holds several places."""
    if found.ambiguity is None:
        return np.zeros(len(found.posed), dtype=np.bool_)
    return np.isin(found.posed, found.ambiguity.frames[found.ambiguity.n_places > 1])


def _steps(axis: Axes, found: RecordingQuality, flat: FloatArray) -> None:
    """Gaps and fast stretches as lines over the path."""
    assert found.coverage is not None
    gaps = [(one.first, one.last) for one in found.coverage.sparse if one.between]
    fast = [(one.first, one.last) for one in found.coverage.fast]
    kinds = ((fast, "--", FAST, 1.5, "turning or moving fast"), (gaps, ":", THIN, 4, "gap between neighbours"))
    for stretches, style, colour, order, what in kinds:
        for number, (first, last) in enumerate(stretches):
            rows = np.flatnonzero((found.posed >= first) & (found.posed <= last))
            label = f"{what} ({len(stretches)})" if number == 0 else None
            axis.plot(*flat[rows].T, style, lw=3 if order > 2 else 2, color=colour, label=label, zorder=order)


def _stretches(axis: Axes, found: RecordingQuality, axes: tuple[int, int], length: float) -> None:
    """Thin stretches with their frames and the direction in which the camera looks."""
    assert found.coverage is not None
    assert found.poses is not None
    for one in found.coverage.sparse:
        at = one.place_xyz[axes[0]], one.place_xyz[axes[1]]
        axis.annotate(
            f"{one.first}-{one.last}",
            at,
            xytext=(8, 8),
            textcoords="offset points",
            fontsize="small",
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": THIN, "lw": 0.8, "alpha": 0.85},
            zorder=6,
        )
        if not one.between:
            _looks(axis, _some(found, one), axes, length)


def _some(found: RecordingQuality, one: SparseStretch) -> Trajectory:
    """A few poses of a stretch, evenly spread."""
    assert found.poses is not None
    rows = np.flatnonzero((found.posed >= one.first) & (found.posed <= one.last))
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), _MOST_ARROWS)).round().astype(np.int64)
    return found.poses[rows[chosen]]


def _looks(axis: Axes, poses: Trajectory, axes: tuple[int, int], length: float) -> None:
    ahead = matrix_from_quat_wxyz(poses.orientations_quat_wxyz)[:, axes, 2] * length
    for place, way in zip(poses.positions_xyz[:, axes], ahead, strict=True):
        axis.annotate("", place + way, place, arrowprops={"arrowstyle": "->", "color": THIN, "lw": 1.4}, zorder=5)
