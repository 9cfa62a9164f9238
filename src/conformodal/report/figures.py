"""The plan of a frame, as SVG text.

Colours are those of Okabe and Ito, which colour-blind people can tell apart; truth is black and dashed as well.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from conformodal.conformal import Regions
from conformodal.core.arrays import FloatArray
from conformodal.core.extras import require_extra
from conformodal.core.words import as_utf8
from conformodal.geometry import Trajectory

with require_extra("figures", "a figure"):
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

COLOURS = {
    "region": "#56B4E9",
    "smoothed": "#0072B2",
    "classical": "#D55E00",
    "truth": "#000000",
    "alike": "#009E73",
    "wall": "#888888",
}
_RING, _LEAST_BOX = 16, 2.5  # points: across a mark, and the width of a box's own line


def plan_figure(
    regions: Regions,
    answer: Trajectory,
    index: int,
    truth: Trajectory | None,
    *,
    classical: Trajectory | None = None,
    walls: Sequence[FloatArray] = (),
    alike: FloatArray | None = None,
    label: str = "conformal, after reasoning",
) -> str:
    """One frame's disjoint regions from above, with the pose of the answer, named `label` in the legend.

    `walls` are (2, 2) segments, `alike` (m, 3) other places with the same view.
    """
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axis = figure.subplots()
    for wall in walls:
        axis.plot(*wall.T, color=COLOURS["wall"], lw=1)
    if truth is not None:
        axis.plot(*truth.positions_xyz[:, :2].T, color=COLOURS["wall"], lw=0.4, alpha=0.6)
    parts = regions.intervals(index)
    edges = regions.bins.edges_
    clip = [np.clip(parts[a], edges[a][0], edges[a][-1]) for a in (0, 1)]
    for (a, b), (c, d) in product(*clip):
        box = Rectangle((a, c), b - a, d - c, fc=COLOURS["region"], ec=COLOURS["region"], lw=_LEAST_BOX)
        axis.add_patch(box)
    axis.add_patch(Rectangle((0, 0), 0, 0, fc=COLOURS["region"], label="calibrated region"))
    # rings and frames, so that a region no larger than a mark is seen in it
    if alike is not None and len(alike):
        style: dict[str, Any] = {"ms": _RING, "mfc": "none", "mew": 1.6, "color": COLOURS["alike"]}
        axis.plot(*alike[:, :2].T, "s", **style, label="places that look the same")
    for path, name, shape, colour, size in (
        (answer, label, "o", "smoothed", _RING),
        (classical, "classical regressor", "X", "classical", 9),
        (truth, "truth", "+", "truth", 7),
    ):
        if path is not None:
            style = {"mew": 1.6, "mfc": "none" if shape == "o" else COLOURS[colour], "color": COLOURS[colour]}
            axis.plot(*path.positions_xyz[index, :2], shape, ms=size, zorder=5, label=name, **style)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x (m)")
    axis.set_ylabel("y (m)")
    figure.legend(loc="outside upper center", ncols=5, frameon=False)
    return as_svg(figure)


def as_label(text: str) -> str:
    """A name as matplotlib shows it: no mathematics, and undecodable bytes with backslashes."""
    return as_utf8(text).replace("$", r"\$")


def as_svg(figure: Figure) -> str:
    """The figure as SVG text, the same from run to run."""
    buffer = io.StringIO()
    # text as text keeps files small and searchable
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.size": 10}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
