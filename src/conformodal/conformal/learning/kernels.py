"""From weights over values to probabilities of bins: kernel smoothing and mixing."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from conformodal.conformal.checks import as_doubles
from conformodal.core.arrays import FloatArray, IntArray

# least density, relative to 1 / range, for logarithms
_FLOOR = 1e-6
_ITERATIONS = 200


def bandwidths(centers: FloatArray, values: FloatArray, factor: float) -> FloatArray:
    """Gaussian bandwidth at each of `centers`: Silverman's rule on `values`, narrower where they are dense.

    Source: Silverman (1986), 3.31; Abramson (1982). `factor` multiplies all.
    """
    centers, values = as_doubles(centers, "centers"), as_doubles(values, "values")
    quartiles = np.quantile(values, [0.25, 0.75])
    spread = min(values.std(), float(np.diff(quartiles)[0]) / 1.34) or values.std()
    pilot = max(0.9 * spread * values.size**-0.2, 1e-9 * (np.ptp(values) or 1.0))
    # the empirical distribution at 512 points stands for all values
    points = np.quantile(values, (np.arange(512) + 0.5) / 512)
    density = np.exp(-0.5 * ((centers[:, None] - points) / pilot) ** 2).mean(axis=1) + 1e-9
    local = np.sqrt(np.exp(np.log(density).mean()) / density)
    return np.asarray(factor * pilot * np.clip(local, 0.2, 5))


def kernel_masses(centers: FloatArray, values: FloatArray, edges: FloatArray, factor: float) -> FloatArray:
    """Mass that a kernel at each of `centers` puts in each bin, (G, K); the outer bins get what lies beyond."""
    centers, edges = as_doubles(centers, "centers"), as_doubles(edges, "edges")
    below = ndtr((edges - centers[:, None]) / bandwidths(centers, values, factor)[:, None])
    below[:, 0], below[:, -1] = 0, 1
    return np.diff(below, axis=1)


def shifted_masses(
    masses: FloatArray, grid: FloatArray, loc: FloatArray, scale: FloatArray, edges: FloatArray
) -> FloatArray:
    """Bin probabilities of ``loc + scale * residual``, (n, K), from masses (n, M) of the residual over `grid` cells."""
    masses, grid, loc, scale, edges = (as_doubles(a, "masses and places") for a in (masses, grid, loc, scale, edges))
    below = np.concatenate((np.zeros((masses.shape[0], 1)), np.cumsum(masses, axis=1)), axis=1)
    at = (edges - loc[:, None]) / scale[:, None]
    cell = np.clip(np.searchsorted(grid, at.ravel()).reshape(at.shape) - 1, 0, grid.size - 2)
    share = np.clip((at - grid[cell]) / np.diff(grid)[cell], 0, 1)
    reached = np.take_along_axis(below, cell, 1) * (1 - share) + np.take_along_axis(below, cell + 1, 1) * share
    reached[:, 0], reached[:, -1] = 0, 1
    return np.maximum(np.diff(reached, axis=1), 0)  # rounding may take a step down


def log_density(proba: FloatArray, codes: IntArray, widths: FloatArray) -> FloatArray:
    """Log density (n,) that rows of bin probabilities give to the bins `codes`, floored."""
    proba, widths = as_doubles(proba, "proba"), as_doubles(widths, "widths")
    density = proba[np.arange(codes.size), codes] / widths[codes]
    return np.asarray(np.log(np.maximum(density, _FLOOR / widths.sum())))


def mixture_weights(log_densities: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Weights (m,) of a mixture that maximise the likelihood of densities (n, m), by expectation-maximisation.

    `weight` (n,) are sample weights. Source: the stacking of densities of Smyth and Wolpert (1999).
    """
    log_densities = as_doubles(log_densities, "log_densities")
    relative = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))
    weights = np.full(relative.shape[1], 1 / relative.shape[1])
    for _ in range(_ITERATIONS):
        shares = relative * weights
        weights = np.average(shares / shares.sum(axis=1, keepdims=True), axis=0, weights=weight)
    return weights
