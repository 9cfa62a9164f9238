"""Regression problems: the tables of the shared data folder, and bimodal data whose density is known."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from sklearn.ensemble import RandomForestRegressor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common import DATA

from conformodal.core.arrays import BoolArray, FloatArray

TABLES = ("concrete", "energy", "temperature", "bio", "births", "air", "bimodal")
MAX_ROWS = 1000  # drawn anew with every seed
# a target with fewer distinct values than this share of its rows lies on a grid
GRID_SHARE = 0.2


@dataclass
class Split:
    """One target of one table, standardised by its training values; 60 % train, 20 % calibration, 20 % test."""

    table: str
    target: str
    seed: int
    X: dict[str, FloatArray]
    y: dict[str, FloatArray]
    grid: FloatArray | None  # distinct values, if the target lies on a grid
    optimal_length: float | None = None  # of the shortest sets, where the density is known

    @cached_property
    def hardest(self) -> BoolArray:
        """The quarter of the test rows (n,) whose residuals forests expect to be largest, one choice for all methods."""
        X, y, options = self.X["train"], self.y["train"], {"random_state": self.seed, "max_features": 0.5}
        location = RandomForestRegressor(200, oob_score=True, **options).fit(X, y)
        spread = RandomForestRegressor(200, min_samples_leaf=10, **options)
        expected = spread.fit(X, np.abs(y - location.oob_prediction_)).predict(self.X["test"])
        return expected >= np.quantile(expected, 0.75)


def read_table(name: str) -> tuple[FloatArray, FloatArray, list[str]]:
    path = DATA / "tables" / f"{name}.csv"
    with path.open(encoding="utf-8") as file:
        header = file.readline().strip().split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    targets = [i for i, column in enumerate(header) if column.startswith("y_")]
    inputs = [i for i in range(len(header)) if i not in targets]
    return values[:, inputs], values[:, targets], [header[i][2:] for i in targets]


def bimodal(n: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Two Gaussian branches ``+-(0.5 + x1)`` of spread ``0.15 (1 + x2^2)``, equally likely."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (n, 2))
    sign = rng.choice([-1.0, 1.0], n)
    return x, sign * (0.5 + x[:, 0]) + bimodal_spread(x) * rng.standard_normal(n)


def bimodal_spread(x: FloatArray) -> FloatArray:
    return np.asarray(0.15 * (1 + x[:, 1] ** 2))


def bimodal_optimum(alpha: float) -> float:
    """Mean length of the shortest sets of coverage 1 - alpha: level sets of the true density, one level for all."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (4000, 2))
    grid = np.linspace(-4, 4, 4001)
    step = grid[1] - grid[0]
    s, m = bimodal_spread(x)[:, None], (0.5 + x[:, 0])[:, None]
    density = sum(np.exp(-0.5 * ((grid - c * m) / s) ** 2) / (2 * s * np.sqrt(2 * np.pi)) for c in (-1, 1))
    flat = np.sort(density.ravel())[::-1]
    level = flat[np.searchsorted(np.cumsum(flat) * step / len(x), 1 - alpha)]
    return float((density >= level).sum() * step / len(x))


def draw(table: str, seed: int, alpha: float) -> Split:
    """The first target of a table, split at random."""
    if table == "bimodal":
        X, y = bimodal(MAX_ROWS, seed)
        target = "y"
    else:
        X, Y, names = read_table(table)
        y, target = Y[:, 0], names[0]
    order = np.random.default_rng(seed).permutation(len(X))[:MAX_ROWS]
    parts = dict(zip(("train", "cal", "test"), np.split(order, [int(s * len(order)) for s in (0.6, 0.8)]), strict=True))
    std = y[parts["train"]].std()
    z = (y - y[parts["train"]].mean()) / std
    distinct = np.unique(z)
    return Split(
        table,
        target,
        seed,
        {part: X[rows] for part, rows in parts.items()},
        {part: z[rows] for part, rows in parts.items()},
        distinct if distinct.size < GRID_SHARE * z.size else None,
        bimodal_optimum(alpha) / std if table == "bimodal" else None,
    )
