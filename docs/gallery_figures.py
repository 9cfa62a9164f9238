"""Draws docs/images/intervals.svg from a small corridor; reliability.svg, size_error.svg and proteins.svg from tables.

python docs/gallery_figures.py intervals       flies, trains and answers first: some minutes
python docs/gallery_figures.py table           reads CONFORMODAL_DATA/tables/temperature.csv and bio.csv
"""

from __future__ import annotations

import argparse
import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from conformodal import ConformalRegressor, Trajectory, coverage_band, draw_coverage, draw_regions
from conformodal.core.arrays import FloatArray

IMAGES = Path(__file__).parent / "images"
TABLE = Path(os.environ.get("CONFORMODAL_DATA", "../shared/data")) / "tables" / "temperature.csv"
TARGETS = {"y_Next_Tmax": "maximum", "y_Next_Tmin": "minimum"}  # of the next day, in degrees Celsius
REGION, PATH, TRUTH, OTHER = "#56B4E9", "#0072B2", "#000000", "#D55E00"
N_MODULES, N_LAPS = 3, 1
EPOCHS, DROPOUT = 30, 0.6  # strong dropout, as in the demo
WIDEST_BAR_S = 0.5
N_SHOWN = 500  # points of a scatter
PROTEINS, N_SETS = 4000, 150  # rows of the table of proteins, a quarter of them unseen; sets that are drawn
AREAS = (7000, 8000, 9500)  # between groups


def run_in_corridor(folder: Path) -> tuple[Any, Trajectory]:
    """Fly, train and answer the frames that were held out at random; the run, and the truth."""
    from conformodal.corridor import write_corridor  # noqa: PLC0415
    from conformodal.features.settings import TrainingConfig  # noqa: PLC0415
    from conformodal.io import read_recording  # noqa: PLC0415 - the table needs no camera
    from conformodal.pipeline.config import ModelConfig  # noqa: PLC0415
    from conformodal.pipeline.estimator import VisualOdometry  # noqa: PLC0415
    from conformodal.pipeline.train import train_model  # noqa: PLC0415

    write_corridor(folder, n_modules=N_MODULES, n_laps=N_LAPS, seed=0)
    sequence = read_recording(folder)
    training = TrainingConfig(epochs=EPOCHS, dropout=DROPOUT, components=None)
    config = ModelConfig(alpha=0.1, sources=("head", "neighbours"), training=training)
    model = train_model(sequence, config)
    run = VisualOdometry(model).process(sequence, model.split.test)
    return run, sequence.require_truth()[run.frames]


def draw_intervals(run: Any, truth: Trajectory) -> Figure:
    """All intervals of x and y over time, the path through them and the truth."""
    figure = Figure(figsize=(10, 4.8), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    times = run.timestamps_s
    width = np.minimum(np.gradient(times), WIDEST_BAR_S)
    for j, axis in enumerate(axes):
        for i, time_s in enumerate(times):
            low, high = run.regions.intervals(i)[j].T
            axis.bar([time_s] * len(low), high - low, width[i], low, color=REGION)
        axis.plot(times, run.trajectory.positions_xyz[:, j], color=PATH, lw=1.5)
        axis.plot(times, truth.positions_xyz[:, j], "--", color=TRUTH, lw=0.9)
        axis.set_ylabel(f"{'xy'[j]} (m)")
        axis.margins(x=0.005)
    axes[1].set_xlabel("time (s)")
    lines = [mpl.lines.Line2D([], [], color=REGION, lw=6)]
    lines += [mpl.lines.Line2D([], [], color=PATH, lw=1.5), mpl.lines.Line2D([], [], color=TRUTH, lw=0.9, ls="--")]
    figure.legend(lines, ["region of each frame", "path", "truth"], loc="outside upper center", ncols=3, frameon=False)
    return figure


@dataclass(frozen=True)
class Fitted:
    """A regressor with the test rows that it has not seen, and how many rows calibrated it."""

    reg: ConformalRegressor
    X: FloatArray
    y: FloatArray
    n_calibration: int


def fit_table() -> Fitted:
    """Weather of the next day: half of the rows train, a quarter calibrates, a quarter tests, at random."""
    table = np.genfromtxt(TABLE, delimiter=",", names=True, deletechars="")
    inputs = [name for name in table.dtype.names if name not in TARGETS]
    X, y = (np.column_stack([table[name] for name in names]) for names in (inputs, TARGETS))
    whole = np.isfinite(X).all(axis=1) & np.isfinite(y).all(axis=1)
    X, y = X[whole], y[whole]
    order = np.random.default_rng(0).permutation(len(X))
    train, calibration, test = np.split(order, [len(X) // 2, 3 * len(X) // 4])
    reg = ConformalRegressor(calibration_size=0, random_state=0).fit(X[train], y[train])
    reg.conformalize(X[calibration], y[calibration])
    return Fitted(reg, X[test], y[test], len(calibration))


def draw_reliability(table: Fitted) -> Figure:
    """Nominal against observed coverage of both targets, and the band that chance alone explains."""
    rates = [round(0.01 * k, 2) for k in range(1, 60)]
    nominal = 1 - np.array(rates)
    regions = [table.reg.predict_region(table.X, alpha=rate) for rate in rates]
    observed = np.array([found.contains(table.y).mean(axis=0) for found in regions])
    low, high = np.array([coverage_band(table.n_calibration, len(table.X), rate) for rate in rates]).T
    figure = Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    for axis, away in ((left, 0.0), (right, nominal)):
        axis.fill_between(nominal, low - away, high - away, color=REGION, alpha=0.5, lw=0, label="99 % by chance alone")
        axis.plot(nominal, nominal - away, "--", color=TRUTH, lw=0.9, label="nominal")
        for j, (name, colour, line) in enumerate(zip(TARGETS.values(), (PATH, OTHER), ("-", "-."), strict=True)):
            axis.plot(nominal, observed[:, j] - away, line, color=colour, lw=1.5, label=f"{name} temperature")
        axis.set_xlabel("nominal coverage, 1 - alpha")
    left.set_ylabel("observed coverage")
    right.set_ylabel("observed minus nominal")
    left.legend(frameon=False, loc="upper left")
    return figure


def draw_sizes(table: Fitted) -> Figure:
    """How far off the prediction is, against the length of the region."""
    lengths, errors = table.reg.predict_region(table.X).length, np.abs(table.reg.predict(table.X) - table.y)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for j, (axis, name) in enumerate(zip(axes, TARGETS.values(), strict=True)):
        axis.plot(lengths[:N_SHOWN, j], errors[:N_SHOWN, j], ".", ms=3, color=REGION, label="a row")
        groups = np.array_split(np.argsort(lengths[:, j]), 10)
        middle = [np.median(lengths[rows, j]) for rows in groups]
        for share, line, said in ((0.9, "o-", "nine in ten of like length are below"), (0.5, "s--", "half are below")):
            found = [np.quantile(errors[rows, j], share) for rows in groups]
            axis.plot(middle, found, line, ms=4, color=PATH, label=said)
        axis.set(title=f"{name} temperature", xlabel="length of the region (degrees)")
    axes[0].set_ylabel("error of the prediction (degrees)")
    axes[0].legend(frameon=False, loc="upper left")
    return figure


def draw_proteins() -> Figure:
    """Sets and density of models of proteins, near the true structure or far from it, and the coverage by group."""
    table = np.random.default_rng(0).permutation(
        np.genfromtxt(TABLE.with_name("bio.csv"), delimiter=",", skip_header=1)
    )
    X, y = table[:PROTEINS, :-1], table[:PROTEINS, -1]
    areas = np.array([f"{low} to {high} Å²" for low, high in itertools.pairwise(("0", *map(str, AREAS), "∞"))])
    groups = areas[np.searchsorted(AREAS, X[:, 0])]
    seen, new = slice(PROTEINS * 3 // 4), slice(PROTEINS * 3 // 4, None)
    reg = ConformalRegressor(random_state=0).fit(X[seen], y[seen], groups=groups[seen])
    some = slice(new.start, new.start + N_SETS)
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    density = reg.predict_density(X[some])
    rank = density.mean[:, 0].argsort().argsort()
    draw_regions(reg.predict_region(X[some], groups=groups[some]), y[some], rank, density, ax=left)
    left.set(xlabel="unseen models, by predicted mean", ylabel="distance from the true structure (Å)")
    draw_coverage(reg.diagnose(X[new], y[new], groups=groups[new]), ax=right)
    right.set_title("coverage by surface area", fontsize="medium")
    return figure


def main() -> None:
    """Draw what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["intervals", "table"])
    if parser.parse_args().what == "intervals":
        with TemporaryDirectory() as folder:
            figures = {"intervals": draw_intervals(*run_in_corridor(Path(folder)))}
    else:
        table = fit_table()
        figures = {"reliability": draw_reliability(table), "size_error": draw_sizes(table), "proteins": draw_proteins()}
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal"}):
        for name, figure in figures.items():
            figure.savefig(IMAGES / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
