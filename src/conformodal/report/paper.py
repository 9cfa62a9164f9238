"""The paper's figures, drawn from stored runs, as vector and as pixels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from scipy.stats import spearmanr

from conformodal.conformal import coverage_band
from conformodal.core.files import replacing, write_whole
from conformodal.core.words import counted

from .figures import COLOURS, as_label, as_svg
from .stored import StoredRun

_PNG_DPI = 150
_REACH = 1.15  # how far beyond the truth's own range a panel shows


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
            if "classical" in run.trajectories:
                other = run.trajectories["classical"].positions_xyz[:, j]
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
    axis.imshow(image)
    step = pixels_next - pixels_prev
    (x, y), (u, v) = pixels_prev.T, step.T
    axis.quiver(x, y, u, v, color=COLOURS["classical"], angles="xy", scale_units="xy", scale=1, width=0.003)
    median = float(np.median(np.linalg.norm(step, axis=1)))
    axis.set_title(f"{counted(len(step), 'corner')}, median step {median:.1f} pixels", fontsize=11)
    axis.set_axis_off()
    return figure


def reliability_figure(
    measured: Sequence[tuple[str, npt.NDArray[np.float64]]], n_calibration: int, n_test: int
) -> Figure:
    """Coverage against 1 - alpha, one curve a split; the band is one target's exact 99 %.

    Parameters
    ----------
    measured
        Label, and (m, 2) pairs of alpha and coverage.
    n_calibration, n_test
        Of the band, which holds where frames are exchangeable.
    """
    figure = Figure(figsize=(5.2, 5), layout="constrained")
    axis = figure.subplots()
    alphas = np.sort(measured[0][1][:, 0])
    band = np.array([coverage_band(n_calibration, n_test, f"{a:g}") for a in alphas])
    axis.fill_between(
        1 - alphas, band[:, 0], band[:, 1], color=COLOURS["wall"], alpha=0.25, lw=0, label="exact 99 % band"
    )
    axis.plot([0, 1], [0, 1], "--", color=COLOURS["truth"], lw=0.8)
    for (label, pairs), colour in zip(measured, (COLOURS["smoothed"], COLOURS["classical"]), strict=False):
        axis.plot(1 - pairs[:, 0], pairs[:, 1], "o-", ms=4, color=colour, label=label)
    axis.set(xlabel="1 - alpha", ylabel="coverage, mean over targets", xlim=(0, 1), ylim=(0, 1))
    axis.legend(loc="lower right", frameon=False)
    return figure


def size_figure(runs: Sequence[tuple[str, StoredRun]]) -> Figure:
    """Size of the position's region against the answer's error, frame by frame; sizes that are infinite left out."""
    figure = Figure(figsize=(4 * len(runs), 3.8), layout="constrained")
    axes = figure.subplots(1, len(runs), squeeze=False, sharex=True, sharey=True)
    sizes, errors = [], []
    for axis, (title, run) in zip(axes[0], runs, strict=True):
        size = run.position_sizes_m()
        error = np.linalg.norm(run.answer.positions_xyz - run.truth.positions_xyz, axis=1)
        known = np.isfinite(size) & (size > 0)
        sizes.append(size[known])
        errors.append(error[known])
        axis.loglog(size[known], np.maximum(error[known], 1e-4), ".", ms=4, color=COLOURS["smoothed"])
        axis.set_title(f"{as_label(title)}: rank correlation {_rank(size[known], error[known]):.2f}", fontsize=10)
        axis.set_xlabel("size of the region (m)")
        for scale in (axis.xaxis, axis.yaxis):  # few plain numbers: ranges of less than a decade have none otherwise
            scale.set_major_locator(LogLocator(subs=(1, 2, 5)))
            scale.set_major_formatter(StrMethodFormatter("{x:g}"))
            scale.set_minor_locator(NullLocator())
    axes[0, 0].set_ylabel("error of the answer (m)")
    together = _rank(np.concatenate(sizes), np.concatenate(errors))
    figure.suptitle(f"all frames together: rank correlation {together:.2f}", fontsize=10)
    return figure


def _rank(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> float:
    return float(spearmanr(a, b).statistic) if len(a) > 2 else float("nan")


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
