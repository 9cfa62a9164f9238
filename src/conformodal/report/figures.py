"""The pictures a person wants first, as SVG text.

Colours are those of Okabe and Ito, which colour-blind people can tell apart; truth is black and dashed as well.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import product

import numpy as np
import numpy.typing as npt

from conformodal.core.extras import require_extra
from conformodal.poses import Trajectory
from conformodal.running.estimates import OdometryRun

with require_extra("figures", "a figure"):
    import matplotlib as mpl
    from matplotlib.axes import Axes
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
_BAND_ALPHA = 0.6
_RING, _LEAST_BOX = 16, 2.5  # points: across a mark, and the width of a box's own line
_LONGEST_CELL_S = 2.0
_ANSWER = "conformal, after reasoning"


def trajectory_figure(
    run: OdometryRun,
    truth: Trajectory | None,
    classical: Trajectory | None = None,
    answer: str = _ANSWER,
) -> str:
    """Position over time with all intervals of every frame's region; `answer` names the trajectory in the legend."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    start = run.timestamps_s[0]
    times = run.timestamps_s - start
    left, right = _time_cells(times)
    intervals = [run.regions.intervals(i) for i in range(len(run.frames))]
    for j, (axis, name) in enumerate(zip(axes, "xyz", strict=True)):
        low, high = run.regions.bins.edges_[j][[0, -1]]
        for t0, t1, parts in zip(left, right, intervals, strict=True):
            for a, b in np.clip(parts[j], low, high):  # the whole line is drawn over the bins
                axis.add_patch(Rectangle((t0, a), t1 - t0, b - a, color=COLOURS["region"], alpha=_BAND_ALPHA, lw=0))
        if classical is not None:
            axis.plot(times, classical.positions_xyz[:, j], ".", ms=2.5, color=COLOURS["classical"])
        axis.plot(times, run.trajectory.positions_xyz[:, j], "-", lw=1.4, color=COLOURS["smoothed"])
        if truth is not None:
            axis.plot(times, truth.positions_xyz[:, j], "--", lw=0.9, color=COLOURS["truth"])
        axis.set_ylabel(f"{name} (m)")
        axis.margins(x=0.005)
    axes[-1].set_xlabel("time (s)")
    _legend(figure, truth is not None, classical is not None, alike=False, answer=answer)
    return as_svg(figure)


def plan_figure(
    run: OdometryRun,
    index: int,
    truth: Trajectory | None,
    *,
    classical: Trajectory | None = None,
    walls: Sequence[npt.NDArray[np.float64]] = (),
    alike: npt.NDArray[np.float64] | None = None,
    axes: tuple[int, int] = (0, 1),
    answer: str = _ANSWER,
) -> str:
    """One frame's disjoint regions from above, with the chosen pose, named `answer` in the legend.

    `walls` are (2, 2) segments, `alike` (m, 3) other places with the same view, `axes` the two horizontal axes.
    """
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axis = figure.subplots()
    for wall in walls:
        axis.plot(*wall.T, color=COLOURS["wall"], lw=1)
    if truth is not None:
        axis.plot(*truth.positions_xyz[:, axes].T, color=COLOURS["wall"], lw=0.4, alpha=0.6)
    parts = run.regions.intervals(index)
    edges = run.regions.bins.edges_
    clip = [np.clip(parts[a], edges[a][0], edges[a][-1]) for a in axes]
    for (a, b), (c, d) in product(*clip):
        box = Rectangle((a, c), b - a, d - c, fc=COLOURS["region"], ec=COLOURS["region"], lw=_LEAST_BOX)
        axis.add_patch(box)
    # rings and frames, so that a region no larger than a mark is seen in it
    if alike is not None and len(alike):
        axis.plot(*alike[:, axes].T, "s", ms=_RING, mfc="none", mew=1.6, color=COLOURS["alike"])
    _marker(axis, run.trajectory, index, axes, "o", COLOURS["smoothed"], _RING)
    if classical is not None:
        _marker(axis, classical, index, axes, "X", COLOURS["classical"], 9)
    if truth is not None:
        _marker(axis, truth, index, axes, "+", COLOURS["truth"], 7)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel(f"{'xyz'[axes[0]]} (m)")
    axis.set_ylabel(f"{'xyz'[axes[1]]} (m)")
    places = alike is not None and len(alike) > 0
    _legend(figure, truth is not None, classical is not None, alike=places, answer=answer, points=True)
    return as_svg(figure)


def error_figure(trajectories: dict[str, Trajectory], truth: Trajectory) -> str:
    """Share of frames below an error in metres, one curve a method; logarithmic, because methods differ in size."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axis = figure.subplots()
    styles = {"smoothed": ("-", COLOURS["smoothed"]), "classical": ("-", COLOURS["classical"])}
    styles |= {"hindsight": ("--", COLOURS["smoothed"]), "online": ("-.", COLOURS["smoothed"])}
    styles |= {"greedy": (":", COLOURS["alike"])}
    share = (np.arange(len(truth)) + 1) / len(truth)
    for name, (line, colour) in styles.items():
        if name in trajectories:
            error = np.linalg.norm(trajectories[name].positions_xyz - truth.positions_xyz, axis=1)
            label = name.replace("_", " ")
            axis.plot(np.sort(np.maximum(error, 1e-4)), share, line, color=colour, label=label, lw=1.6)
    axis.set_xscale("log")
    axis.set_xlabel("position error (m)")
    axis.set_ylabel("share of frames")
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right", frameon=False)
    return as_svg(figure)


def _time_cells(
    times: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """From and to when a frame's bands are drawn: half-way to its neighbours, but no further than a second."""
    gaps = np.minimum(np.diff(times), _LONGEST_CELL_S) / 2
    ends = np.median(gaps) if len(gaps) else 0.5
    return times - np.concatenate(([ends], gaps)), times + np.concatenate((gaps, [ends]))


def _marker(
    axis: Axes, path: Trajectory, index: int, axes: tuple[int, int], shape: str, colour: str, size: int
) -> None:
    x, y = path.positions_xyz[index, axes]
    fill = "none" if shape == "o" else colour
    axis.plot([x], [y], shape, ms=size, mew=1.6, mfc=fill, color=colour, zorder=5)


def _legend(figure: Figure, truth: bool, classical: bool, *, alike: bool, answer: str, points: bool = False) -> None:
    entries = [Rectangle((0, 0), 1, 1, color=COLOURS["region"], alpha=1 if points else _BAND_ALPHA)]
    labels = ["calibrated region"]
    lines = [("smoothed", answer, "o", "-", True), ("truth", "truth", "+", "--", truth)]
    lines.append(("classical", "classical regressor", "X" if points else ".", "", classical))
    lines.append(("alike", "places that look the same", "s", "", alike))
    for key, label, shape, line, shown in lines:
        if shown:
            fill = "none" if key == "alike" or (points and key == "smoothed") else COLOURS[key]
            style = {"marker": shape, "ls": "", "mfc": fill, "ms": 8} if points or not line else {"ls": line}
            entries.append(mpl.lines.Line2D([], [], color=COLOURS[key], **style))  # type: ignore[arg-type]
            labels.append(label)
    figure.legend(entries, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def as_label(text: str) -> str:
    """A name as matplotlib shows it: no mathematics, and undecodable bytes with backslashes."""
    return text.encode("utf-8", "backslashreplace").decode().replace("$", r"\$")


def as_svg(figure: Figure) -> str:
    """The figure as SVG text, the same from run to run."""
    buffer = io.StringIO()
    # text as text keeps files small and searchable
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.size": 10}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
