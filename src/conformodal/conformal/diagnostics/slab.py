"""Worst-slab coverage: the strip of the inputs, in any direction, with the lowest coverage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, as_count, as_doubles, as_flags, as_number, as_random
from conformodal.conformal.errors import ConformodalError
from conformodal.core.arrays import AnyArray, BoolArray, FloatArray

from .coverage import CoverageCheck, check_coverage

# samples that choose the slab, drawn at random; half of all if these are fewer
_MOST_CHOOSE = 2000


@dataclass(frozen=True)
class SlabCheck:
    """A slab ``low <= direction . x <= high``, chosen on some test samples and checked on the others."""

    direction: FloatArray  # (p,) weights of the inputs, each divided by its standard deviation
    low: float
    high: float
    coverage: CoverageCheck | None  # of the other samples in the slab; None if none is


def worst_slab(
    inside: npt.ArrayLike,
    X: npt.ArrayLike,
    n_calibration: int,
    alpha: Alpha,
    mass: float = 0.2,
    directions: int = 500,
    level: float = 0.99,
    random_state: Any = 0,
) -> SlabCheck:
    """Search random directions for the slab with the lowest coverage on half of the samples; check it on the others.

    The minimum over many slabs is far below the coverage of any one. The second half is independent of that choice, so
    its band is that of a slab chosen in advance (:func:`coverage_by_group`). The axes are among the directions. Of more
    than 4000 samples 2000 choose. `X` (n_test, p) are inputs, `mass` the least share of the first half's samples in the
    slab; the rest is as in :func:`check_coverage`.

    Source: Cauchois, Gupta and Duchi (2021); split in two as by Romano, Sesia and Candes (2020).
    """
    inside, inputs = as_flags(inside, "inside", 1), as_doubles(X, "X")
    if inputs.ndim != 2 or inputs.shape[0] != inside.size or not inputs.shape[1] or not np.isfinite(inputs).all():
        raise ConformodalError(f"X must be finite, of shape ({inside.size}, p), got shape {inputs.shape}")
    if inside.size < 2:
        raise ConformodalError(f"a slab needs at least 2 samples, one for either half, got {inside.size}")
    mass = as_number(mass, "mass", "a share in (0, 1]", lambda share: 0 < share <= 1)
    directions, random = as_count(directions, "directions"), as_random(random_state)
    with np.errstate(over="ignore", invalid="ignore"):
        spread = inputs.std(axis=0)
    if not np.isfinite(spread).all():
        raise ConformodalError(f"X is too large for float64 to hold its spread, up to {np.abs(inputs).max():g}")
    scaled = np.divide(inputs, spread, out=np.zeros_like(inputs), where=spread > 0)
    order = random.permutation(len(inputs))
    first, second = np.split(order, [min(len(order) // 2, _MOST_CHOOSE)])
    tried = random.standard_normal((directions, inputs.shape[1]))
    tried = np.concatenate((np.eye(inputs.shape[1]), tried / np.linalg.norm(tried, axis=1, keepdims=True)))
    least = max(1, int(np.ceil(mass * first.size)))
    slabs = (_lowest_slab(inside[first], scaled[first] @ direction, least) for direction in tried)
    best, (_, low, high) = min(enumerate(slabs), key=lambda one: one[1][0])
    at = scaled[second] @ tried[best]
    held = inside[second][(low <= at) & (at <= high)]
    check = check_coverage(held, n_calibration, alpha, level) if held.size else None
    return SlabCheck(tried[best], low, high, check)


def _lowest_slab(inside: BoolArray, at: FloatArray, least: int) -> tuple[float, float, float]:
    """Coverage and ends of the slab with the lowest coverage along one direction, from the samples' places `at`."""
    ranked = np.argsort(at, kind="stable")
    start, stop = lowest_run(inside[ranked], least)
    return float(inside[ranked][start:stop].mean()), float(at[ranked[start]]), float(at[ranked[stop - 1]])


def lowest_run(values: AnyArray, least: int) -> tuple[int, int]:
    """Start and stop of the run of at least `least` values with the smallest mean, exactly.

    Dinkelbach's iteration: for a guess of the mean, the run whose sum falls furthest below it gives the next guess.
    """
    total = np.concatenate(([0.0], np.cumsum(values, dtype=np.float64)))
    steps = np.arange(total.size)
    start, stop = 0, values.size
    while True:
        mean = (total[stop] - total[start]) / (stop - start)
        excess = total - mean * steps
        highest = np.maximum.accumulate(excess[: total.size - least])
        gain = excess[least:] - highest
        at = int(gain.argmin())
        if gain[at] >= -1e-9:
            return start, stop
        stop = at + least
        start = int(excess[: at + 1].argmax())
