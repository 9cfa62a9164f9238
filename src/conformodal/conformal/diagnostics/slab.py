"""Worst-slab coverage: the strip of the inputs, in any direction, with the lowest coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, as_doubles, as_flags, as_random
from conformodal.conformal.errors import ConformodalError
from conformodal.core.arrays import AnyArray, BoolArray, FloatArray

from .coverage import CoverageCheck, check_coverage

# samples that choose the slab, drawn at random; half of all if these are fewer
_MOST_CHOOSE = 2000
# random directions, and the least share of the choosing samples in a slab
_DIRECTIONS, _LEAST_SHARE = 500, 0.2


def worst_slab(
    inside: npt.ArrayLike,
    X: npt.ArrayLike,
    n_calibration: int,
    alpha: Alpha,
    level: float = 0.99,
    random_state: Any = 0,
) -> CoverageCheck | None:
    """Search random directions for the slab with the lowest coverage on half of the samples; check it on the others.

    The minimum over many slabs is far below the coverage of any one. The second half is independent of that choice, so
    its band is that of a slab chosen in advance (:func:`coverage_by_group`); None if none of its samples is in the
    slab. The axes are among the directions. `X` (n_test, p) are inputs; the rest is as in :func:`check_coverage`.

    Source: Cauchois, Gupta and Duchi (2021); split in two as by Romano, Sesia and Candes (2020).
    """
    inside, inputs = as_flags(inside, "inside", 1), as_doubles(X, "X")
    if inputs.ndim != 2 or inputs.shape[0] != inside.size or not inputs.shape[1] or not np.isfinite(inputs).all():
        raise ConformodalError(f"X must be finite, of shape ({inside.size}, p), got shape {inputs.shape}")
    if inside.size < 2:
        raise ConformodalError(f"a slab needs at least 2 samples, one for either half, got {inside.size}")
    random = as_random(random_state)
    with np.errstate(over="ignore", invalid="ignore"):
        spread = inputs.std(axis=0)
    if not np.isfinite(spread).all():
        raise ConformodalError(f"X is too large for float64 to hold its spread, up to {np.abs(inputs).max():g}")
    scaled = np.divide(inputs, spread, out=np.zeros_like(inputs), where=spread > 0)
    first, second = np.split(random.permutation(len(inputs)), [min(len(inputs) // 2, _MOST_CHOOSE)])
    directions = random.standard_normal((_DIRECTIONS, inputs.shape[1]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    least = max(1, int(np.ceil(_LEAST_SHARE * first.size)))
    slabs = [
        (*_lowest_slab(inside[first], scaled[first] @ direction, least), direction)
        for direction in (*np.eye(inputs.shape[1]), *directions)
    ]
    _, low, high, direction = min(slabs, key=lambda slab: slab[0])
    at = scaled[second] @ direction
    held = inside[second][(low <= at) & (at <= high)]
    return check_coverage(held, n_calibration, alpha, level) if held.size else None


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
