"""The paper's figures, drawn from stored runs, as vector and as pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from conformodal.core.arrays import FloatArray
from conformodal.core.files import replacing, write_whole
from conformodal.core.words import as_utf8, counted
from conformodal.geometry import Trajectory
from conformodal.io.pose_files import read_tum
from conformodal.pipeline.results import ResultsError, read_region_records, read_trajectories
from conformodal.report.figures import as_svg

# those of Okabe and Ito, which colour-blind people can tell apart; truth is black and dashed as well
COLOURS = {"region": "#56B4E9", "smoothed": "#0072B2", "classical": "#D55E00", "truth": "#000000", "wall": "#888888"}
_PNG_DPI = 150
_REACH = 1.15  # how far beyond the truth's own range a panel shows
_OUTSIDE = "#BBBBBB"  # bins that are not in the set
_MIN_SHOWN, _BELOW_THRESHOLD = 1e-4, 30.0  # where bars begin
_STRIP = 0.025  # height of the intervals along the bottom, as a share of the panel's
_MIN_BOX = 1.5  # points: the line around a cuboid, so that a narrow one is seen


def as_label(text: str) -> str:
    """A name as matplotlib shows it: no mathematics, and undecodable bytes with backslashes."""
    return as_utf8(text).replace("$", r"\$")


@dataclass(frozen=True, eq=False)
class StoredRun:
    """Trajectories by method (the answer first), the truth, and one region record a frame."""

    trajectories: dict[str, Trajectory]
    truth: Trajectory
    records: list[dict[str, Any]]

    @classmethod
    def read(cls, folder: Path) -> StoredRun:
        """What ``conformodal run`` or the table wrote.

        Raises
        ------
        ResultsError, DatasetError
            If files are missing or damaged, or differ in length.
        """
        found = cls(
            read_trajectories(folder), read_tum(folder / "truth.tum"), read_region_records(folder / "regions.jsonl")
        )
        if not len(found.answer) == len(found.truth) == len(found.records):
            raise ResultsError(
                f"{folder}: trajectory, truth and regions differ in length; was a run overwritten half-way?"
            )
        return found

    @property
    def answer(self) -> Trajectory:
        """The smoothed trajectory."""
        return next(iter(self.trajectories.values()))

    @property
    def times_s(self) -> npt.NDArray[np.float64]:
        """Seconds since the first frame."""
        return np.asarray(self.answer.timestamps_s - self.answer.timestamps_s[0])

    def intervals(self, frame: int, target: str) -> npt.NDArray[np.float64]:
        """(m, 2) ends of a target's intervals; infinite for the whole line."""
        parts = [
            (-np.inf if a is None else a, np.inf if b is None else b)
            for a, b in self.records[frame]["intervals"][target]
        ]
        return np.array(parts).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class SoftmaxOfTarget:
    """One image's softmax of one target.

    Attributes
    ----------
    target
        Its name.
    edges
        (K + 1,) of the bins, metres.
    proba
        (K,) probabilities.
    least
        Least probability of a bin in the set, 1 - q.
    intervals
        (m, 2) ends of the set's intervals.
    truth
        The true value.
    """

    target: str
    edges: FloatArray
    proba: npt.NDArray[np.floating[Any]]
    least: float
    intervals: FloatArray
    truth: float


@dataclass(frozen=True, eq=False)
class Steps:
    """What the overview shows of one frame.

    Attributes
    ----------
    image
        (h, w, 3) RGB.
    softmaxes
        Of x, y and z.
    shown
        Which of them has its softmax drawn.
    flow
        Corners (m, 2) in an earlier frame and in this one, in pixels.
    answer, truth
        Chosen and true positions (n, 3) of all frames of the run.
    frame
        Which of the n.
    """

    image: npt.NDArray[np.uint8]
    softmaxes: Sequence[SoftmaxOfTarget]
    shown: int
    flow: tuple[FloatArray, FloatArray]
    answer: FloatArray
    truth: FloatArray
    frame: int


def save_figure(figure: Figure, folder: Path, name: str) -> None:
    """Write ``NAME.svg`` and ``NAME.png``."""
    write_whole(folder / f"{name}.svg", as_svg(figure))
    with replacing(folder / f"{name}.png") as part:
        figure.savefig(part, format="png", dpi=_PNG_DPI, metadata={"Software": "conformodal"})


def band_figure(runs: Sequence[tuple[str, StoredRun]], answer: str) -> Figure:
    """Positions over time with their regions' bands, one column a run (figures 4 to 6).

    Bands of one target share an axis, so that widths can be compared across columns.

    Parameters
    ----------
    runs
        With their titles.
    answer
        What the legend calls their answers.
    """
    figure = Figure(figsize=(1 + 3.6 * len(runs), 6.5), layout="constrained")
    axes = figure.subplots(3, len(runs), sharey="row", sharex=True, squeeze=False)
    for column, (title, run) in enumerate(runs):
        axes[0, column].set_title(as_label(title), fontsize=11)
        times = run.times_s
        half = min(0.5, float(np.median(np.diff(times)))) / 2 if len(times) > 1 else 0.5
        for j, target in enumerate("xyz"):
            axis = axes[j, column]
            low, high = _shown(run.truth.positions_xyz[:, j])
            for i, t in enumerate(times):
                for a, b in np.clip(run.intervals(i, target), low, high):
                    axis.add_patch(Rectangle((t - half, a), 2 * half, b - a, color=COLOURS["region"], alpha=0.6, lw=0))
            if "tuned" in run.trajectories:
                other = run.trajectories["tuned"].positions_xyz[:, j]
                axis.plot(times, other, ".", ms=2.5, color=COLOURS["classical"])
            axis.plot(times, run.answer.positions_xyz[:, j], "-", lw=1.2, color=COLOURS["smoothed"])
            axis.plot(times, run.truth.positions_xyz[:, j], "--", lw=0.8, color=COLOURS["truth"])
            axis.set_ylim(low, high)
            if column == 0:
                axis.set_ylabel(f"{target} (m)")
        axes[2, column].set_xlabel("time (s)")
    _legend(figure, answer)
    return figure


def cuboid_figure(runs: Sequence[tuple[str, StoredRun]], frame: int) -> Figure:
    """One frame's disjoint cuboids in space, one panel a run (figures 2c and 2d)."""
    figure = Figure(figsize=(5.2 * len(runs), 5), layout="constrained")
    for k, (title, run) in enumerate(runs):
        axis = figure.add_subplot(1, len(runs), k + 1, projection="3d")
        ranges = [_shown(run.truth.positions_xyz[:, j]) for j in range(3)]
        parts = [np.clip(run.intervals(frame, t), *ranges[j]) for j, t in enumerate("xyz")]
        cuboids = list(product(*parts))
        for x, y, z in cuboids:
            size = (np.ptp(x), np.ptp(y), np.ptp(z))
            axis.bar3d(
                x[0], y[0], z[0], *size, color=COLOURS["region"], alpha=0.35, edgecolor=COLOURS["smoothed"], lw=0.5
            )
        axis.plot(*run.truth.positions_xyz.T, color=COLOURS["wall"], lw=0.6)
        for path, style, colour in ((run.answer, "o", COLOURS["smoothed"]), (run.truth, "+", COLOURS["truth"])):
            axis.plot(*path.positions_xyz[frame, :, None], style, ms=9, mew=2, color=colour)
        axis.set(xlim=ranges[0], ylim=ranges[1], zlim=ranges[2], xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        axis.locator_params(nbins=5)
        axis.set_box_aspect(None, zoom=0.88)  # else labels are cut off
        axis.set_title(f"{as_label(title)}: {counted(len(cuboids), 'cuboid')}", fontsize=11)
    return figure


def flow_figure(
    image: npt.NDArray[np.uint8], pixels_prev: npt.NDArray[np.float64], pixels_next: npt.NDArray[np.float64]
) -> Figure:
    """Corners followed from the frame before into this one (figure 3)."""
    height, width = image.shape[:2]
    figure = Figure(figsize=(7, 7 * height / width + 0.4), layout="constrained")
    axis = figure.subplots()
    _flow(axis, image, pixels_prev, pixels_next)
    step = pixels_next - pixels_prev
    median = float(np.median(np.linalg.norm(step, axis=1)))
    axis.set_title(f"{counted(len(step), 'corner')}, median step {median:.1f} pixels", fontsize=11)
    return figure


def binning_figure(times_s: FloatArray, values: FloatArray, edges: FloatArray, target: str) -> Figure:
    """Bins of equal mass over the training trajectory, and the one-hot labels that follow (figure 2a).

    Parameters
    ----------
    times_s, values
        (n,) of the training frames.
    edges
        (K + 1,) of the bins.
    target
        Its name.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    path, labels = figure.subplots(1, 2)
    for k, (low, high) in enumerate(pairwise(edges)):
        path.axhspan(low, high, color=COLOURS["region"] if k % 2 else "none", alpha=0.25, lw=0)
    for edge in edges:
        path.axhline(edge, color=COLOURS["wall"], lw=0.6)
    path.plot(times_s, values, ".", ms=3, color=COLOURS["smoothed"])
    path.set(xlabel="time (s)", ylabel=f"{target} (m)", ylim=(edges[0], edges[-1]))
    path.set_title(f"training trajectory, {counted(len(edges) - 1, 'bin')} of equal mass", fontsize=11)
    code = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    hot = np.zeros((len(edges) - 1, len(values)))
    hot[code, np.arange(len(values))] = 1
    labels.imshow(hot, origin="lower", aspect="auto", interpolation="nearest", cmap="Blues", vmax=1.2)
    labels.set(xlabel="training frame", ylabel=f"bin of {target}")
    labels.set_title("one-hot labels", fontsize=11)
    return figure


def softmax_figure(softmax: SoftmaxOfTarget) -> Figure:
    """A softmax, the calibrated threshold, and the disjoint set of bins that reach it (figure 2b)."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    _bars(axis, softmax)
    n = len(softmax.intervals)
    axis.set_title(f"{counted(n, 'interval')}", fontsize=11)
    axis.set_ylabel("softmax")
    entries = [Rectangle((0, 0), 1, 1, color=c) for c in (COLOURS["region"], _OUTSIDE)]
    lines = [("-.", COLOURS["classical"]), ("--", COLOURS["truth"])]
    entries += [mpl.lines.Line2D([], [], ls=style, color=colour) for style, colour in lines]  # type: ignore[misc]
    entries.append(mpl.lines.Line2D([], [], lw=4, color=COLOURS["smoothed"]))  # type: ignore[arg-type]
    names = ["bins in the set", "other bins", f"threshold 1 - q = {softmax.least:.2g}", "truth", "the set's intervals"]
    figure.legend(entries, names, loc="outside upper center", ncols=3, frameon=False)
    return figure


def overview_figure(steps: Steps) -> Figure:
    """From an image to the path, one panel a step (figure 1)."""
    height, width = steps.image.shape[:2]
    figure = Figure(figsize=(20, 4.1), layout="constrained")
    axes = figure.subplots(1, 6, width_ratios=[1.1 * width / height, 1.1, 1.1, 1.2, 1.1 * width / height, 1.2])
    titles = ["image", "softmax, threshold", "disjoint sets", "cuboids", "optical flow", "reasoned path"]
    for number, (axis, title) in enumerate(zip(axes, titles, strict=True), start=1):
        axis.set_title(f"{number}  {title}", fontsize=12)
    axes[0].imshow(steps.image)
    axes[0].set_axis_off()
    shown = steps.softmaxes[steps.shown]
    _bars(axes[1], shown)
    axes[1].set_ylabel("softmax")
    _sets(axes[2], steps.softmaxes)
    longest = next(j for j in np.argsort(-np.ptp(steps.truth, axis=0)).tolist() if j != steps.shown)
    flat = sorted((steps.shown, longest))
    for axis in (axes[3], axes[5]):
        _cuboids(axis, steps, flat)
    _flow(axes[4], steps.image, *steps.flow)
    axes[5].plot(*steps.answer[: steps.frame + 1, flat].T, "-", lw=1, color=COLOURS["smoothed"], zorder=3)
    axes[5].plot(*steps.answer[steps.frame, flat], "o", ms=9, mfc="none", mew=1.8, color=COLOURS["smoothed"], zorder=5)
    entries = [
        Rectangle((0, 0), 1, 1, color=COLOURS["region"]),
        mpl.lines.Line2D([], [], ls="-.", color=COLOURS["classical"]),
        mpl.lines.Line2D([], [], marker="o", mfc="none", color=COLOURS["smoothed"]),
        mpl.lines.Line2D([], [], marker="+", ls="--", color=COLOURS["truth"]),
    ]
    names = ["calibrated set", "threshold", "chosen poses so far, and of this frame", "truth"]
    figure.legend(entries, names, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _bars(axis: Axes, softmax: SoftmaxOfTarget) -> None:
    """Bars on a log scale, because thresholds are far below the peaks; the set's intervals lie along the bottom."""
    inside = softmax.proba >= softmax.least
    colours = [COLOURS["region"] if here else _OUTSIDE for here in inside]
    axis.set_yscale("log")
    axis.bar(softmax.edges[:-1], softmax.proba, np.diff(softmax.edges), align="edge", color=colours, ec="white", lw=0.3)
    bottom = _MIN_SHOWN
    if softmax.least > 0:
        axis.axhline(softmax.least, ls="-.", lw=1.2, color=COLOURS["classical"])
        bottom = softmax.least / _BELOW_THRESHOLD
    axis.axvline(softmax.truth, ls="--", lw=1, color=COLOURS["truth"])
    for a, b in np.clip(softmax.intervals, softmax.edges[0], softmax.edges[-1]):
        ends = [_STRIP, _STRIP]
        axis.plot(
            [a, b], ends, lw=4, color=COLOURS["smoothed"], solid_capstyle="butt", transform=axis.get_xaxis_transform()
        )
    axis.set(xlabel=f"{softmax.target} (m)", xlim=(softmax.edges[0], softmax.edges[-1]), ylim=(bottom, 1))


def _sets(axis: Axes, softmaxes: Sequence[SoftmaxOfTarget]) -> None:
    """Intervals of every target over its range."""
    for row, softmax in enumerate(softmaxes):
        low, high = softmax.edges[[0, -1]]
        place = (np.clip(softmax.intervals, low, high) - low) / (high - low)
        axis.plot([0, 1], [row, row], lw=1, color=COLOURS["wall"])
        for a, b in place:
            axis.add_patch(Rectangle((a, row - 0.2), b - a, 0.4, fc=COLOURS["region"], ec=COLOURS["region"], lw=1))
        axis.plot((softmax.truth - low) / (high - low), row, "+", ms=11, mew=1.6, color=COLOURS["truth"])
    axis.set_yticks(range(len(softmaxes)), [s.target for s in softmaxes])
    axis.set(xlabel="share of the training range", ylim=(len(softmaxes) - 0.5, -0.5))


def _cuboids(axis: Axes, steps: Steps, flat: Sequence[int]) -> None:
    axis.plot(*steps.truth[:, flat].T, "--", lw=0.8, color=COLOURS["truth"], alpha=0.6)
    parts = [steps.softmaxes[j] for j in flat]
    clipped = [np.clip(s.intervals, s.edges[0], s.edges[-1]) for s in parts]
    for (a, b), (c, d) in product(*clipped):
        axis.add_patch(
            Rectangle((a, c), b - a, d - c, fc=COLOURS["region"], ec=COLOURS["region"], lw=_MIN_BOX, zorder=2)
        )
    axis.plot(*steps.truth[steps.frame, flat], "+", ms=11, mew=1.8, color=COLOURS["truth"], zorder=6)
    axis.set(xlabel=f"{parts[0].target} (m)", ylabel=f"{parts[1].target} (m)")
    axis.set_aspect("equal", adjustable="datalim")


def _flow(axis: Axes, image: npt.NDArray[np.uint8], before: FloatArray, now: FloatArray) -> None:
    axis.imshow(image)
    (x, y), (u, v) = before.T, (now - before).T
    axis.quiver(x, y, u, v, color=COLOURS["classical"], angles="xy", scale_units="xy", scale=1, width=0.0035)
    axis.set_axis_off()


def _shown(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    middle, half = (values.max() + values.min()) / 2, max(np.ptp(values) / 2, 1e-3) * _REACH
    return float(middle - half), float(middle + half)


def _legend(figure: Figure, answer: str) -> None:
    entries = [
        Rectangle((0, 0), 1, 1, color=COLOURS["region"], alpha=0.6),
        mpl.lines.Line2D([], [], color=COLOURS["smoothed"]),
        mpl.lines.Line2D([], [], color=COLOURS["truth"], ls="--"),
        mpl.lines.Line2D([], [], color=COLOURS["classical"], marker=".", ls=""),
    ]
    labels = ["calibrated region", answer, "truth", "tuned regressor"]
    figure.legend(entries, labels, loc="outside upper center", ncols=4, frameon=False)
