"""The plan of a recording and errors over time, as SVG text, and the page of a recording's quality.

Colours are those of Okabe and Ito, which colour-blind people can tell apart; truth is black and dashed as well.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray, rows_by_label
from conformodal.core.extras import require_extra
from conformodal.core.files import write_whole
from conformodal.pipeline.results import PAGE
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.view_coverage import QUALITY

from .page import METHOD_LABELS, render_page

with require_extra("figures", "a figure"):
    import matplotlib as mpl
    from matplotlib.figure import Figure

# of a recording: every kind has a mark of its own too, so that the plan is read without colour
_GOOD, _SPARSE, _FAST, _AMBIGUOUS, _PATH = "#0072B2", "#D55E00", "#E69F00", "#CC79A7", "#888888"
_RECORDINGS = {_GOOD: ".", "#009E73": "^", "#56B4E9": "v", "#000000": "D"}
_PLAN = "figures/plan.svg"
_LONGEST, _SHORTEST = 8.5, 3.2  # inches of the plan of a recording


def quality_plan(quality: RecordingQuality) -> str | None:
    """The recording seen along the axis that it spreads least along, as SVG text; None where it has no poses."""
    if quality.poses is None or quality.coverage is None:
        return None
    flat = quality.poses.positions_xyz[:, quality.axes]
    width, height = np.maximum(np.ptp(flat, axis=0), 1e-6)
    tall = float(np.clip(_LONGEST * height / width, _SHORTEST, _LONGEST))
    figure = Figure(figsize=(10, tall + 1.2), layout="constrained")
    axis = figure.subplots()
    recording = quality.sequence.recording[quality.posed]
    for rows in rows_by_label(recording):
        axis.plot(*flat[rows].T, "-", lw=1, color=_PATH, alpha=0.6, zorder=1)
    note: dict[str, Any] = {"textcoords": "offset points", "fontsize": "small", "zorder": 6}
    axis.annotate("start", flat[0], xytext=(-6, -14), **note)
    sparse, ambiguous = quality.coverage.sparse_frames, np.zeros(len(flat), dtype=np.bool_)
    if quality.ambiguity is not None:
        ambiguous = np.isin(quality.posed, quality.ambiguity.frames[quality.ambiguity.n_places > 1])
    well, numbers = ~sparse & ~ambiguous, np.unique(recording).tolist()
    kinds = [(well, "well covered", ".", 5, _GOOD)]
    if 1 < len(numbers) <= len(_RECORDINGS):  # more could not be told apart
        kinds = [
            (well & (recording == k), f"recording {k + 1}, well covered", mark, 5, colour)
            for k, (colour, mark) in zip(numbers, _RECORDINGS.items(), strict=False)
        ]
    kinds += [(ambiguous, "ambiguous", "s", 9, _AMBIGUOUS), (sparse, "sparsely covered", "x", 6, _SPARSE)]
    for chosen, label, mark, size, colour in kinds:
        if chosen.any():
            style: dict[str, Any] = {"ms": size, "mfc": "none", "mew": 1.5, "color": colour, "zorder": 3}
            axis.plot(*flat[chosen].T, mark, label=f"{label} ({chosen.sum()})", **style)
    for number, one in enumerate(quality.coverage.fast):
        name = f"fast motion ({len(quality.coverage.fast)})" if number == 0 else None
        fast = (quality.posed >= one.first) & (quality.posed <= one.last)
        axis.plot(*flat[fast].T, "--", lw=2, color=_FAST, label=name, zorder=1.5)
    box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": _SPARSE, "lw": 0.8, "alpha": 0.85}
    for one in quality.coverage.sparse:
        place = np.array(one.place_xyz)[list(quality.axes)].tolist()
        axis.annotate(f"{one.first}-{one.last}", place, xytext=(8, 8), bbox=box, **note)
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.08)
    first, second = (f"{'xyz'[k]} ({quality.sequence.unit})" for k in quality.axes)
    axis.set(xlabel=first, ylabel=second)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return as_svg(figure)


def errors_figure(times_s: FloatArray, errors: dict[str, FloatArray], unit: str) -> str:
    """Errors (n, 2) of positions and orientations over time, by method, as SVG text; (n, 1) of positions alone."""
    n = next(iter(errors.values())).shape[1]
    figure = Figure(figsize=(10, 1 + 2.5 * n), layout="constrained")
    axes = figure.subplots(n, sharex=True, squeeze=False)[:, 0]
    for (name, of_method), colour in zip(errors.items(), (_GOOD, _SPARSE, _FAST, _AMBIGUOUS), strict=False):
        style: dict[str, Any] = {"ms": 3, "lw": 0.8, "color": colour, "label": METHOD_LABELS.get(name, name)}
        for axis, values in zip(axes, of_method.T, strict=True):
            axis.plot(times_s - times_s[0], values, ".-", **style)
    scale = "log" if all((of_method > 0).any(axis=0).all() for of_method in errors.values()) else "linear"
    for axis, what in zip(axes, (f"position ({unit})", "orientation (degrees)"), strict=False):
        axis.set(yscale=scale, ylabel=what)
    axes[-1].set_xlabel("time (s)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return as_svg(figure)


def write_quality_page(
    folder: Path, quality: RecordingQuality | None, record: dict[str, Any], findings: list[str]
) -> None:
    """Write ``report.html`` and ``figures/plan.svg`` from the content of ``metrics.json`` and a line per finding.

    Without findings about the quality, those of an earlier check are removed.
    """
    for name in (PAGE, _PLAN):
        (folder / name).unlink(missing_ok=True)
    if quality is None:
        return
    plan = quality_plan(quality)
    if plan is not None:
        write_whole(folder / _PLAN, plan)
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


def as_svg(figure: Figure) -> str:
    """The figure as SVG text, the same from run to run."""
    buffer = io.StringIO()
    # text as text keeps files small and searchable
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.size": 10}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
