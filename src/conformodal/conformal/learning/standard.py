"""Checked features and weights, and values of mean zero and unit spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.checks import as_doubles, as_finite
from conformodal.conformal.errors import ConformalError
from conformodal.core.arrays import FloatArray, IntArray

# least spread of the values: distances in units of a smaller one may overflow
_LEAST_SPREAD = 1e-150


@dataclass
class Standardised:
    """A table with its values and the edges of their bins, both standardised."""

    X: FloatArray
    z: FloatArray
    weight: FloatArray
    edges: FloatArray
    z_edges: FloatArray

    @property
    def codes(self) -> IntArray:
        """Bin (n,) of every value; values beyond the edges are in the outer bins."""
        return np.searchsorted(self.z_edges[1:-1], self.z, side="right")


def standardised(
    X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None
) -> Standardised:
    """Check features (n, p), values (n,), edges (K + 1,) and weights (n,); rows of weight zero are left out."""
    features, values = as_features(X), as_finite(y, "y", "(n,)")
    if values.shape != features.shape[:1]:
        raise ConformalError(f"y must have one value per row of X ({features.shape[0]}), got {values.size}")
    weight = np.ones(values.size) if sample_weight is None else as_sample_weight(sample_weight, values.size)
    kept = weight > 0
    if not kept.all():
        features, values, weight = features[kept], values[kept], weight[kept]
    if values.size < 2:
        raise ConformalError(f"X must have at least 2 rows to learn a density, got n_samples={values.size}")
    (checked,) = QuantileBins.from_edges([edges]).edges_
    with np.errstate(over="ignore", invalid="ignore"):
        center, scale = float(values.mean()), float(values.std()) or 1.0
    if not (np.isfinite([center, scale]).all() and scale >= _LEAST_SPREAD):
        raise ConformalError(f"y has a spread that float64 cannot work with, {scale:g} around {center:g}")
    return Standardised(features, (values - center) / scale, weight, checked, (checked - center) / scale)


def as_features(X: npt.ArrayLike) -> FloatArray:
    """Finite features (n, p) that float32 can hold, as trees need."""
    features = as_finite(X, "X", "(n, p)")
    most = float(np.finfo(np.float32).max)
    if not features.shape[1] or (features.size and np.abs(features).max() > most):
        raise ConformalError(f"X must have a column and numbers that float32 can hold, up to {most:.3g}, as trees do")
    return features


def as_sample_weight(sample_weight: npt.ArrayLike, n: int) -> FloatArray:
    """Weights (n,) of samples, scaled so that the positive ones have mean one."""
    given = as_doubles(sample_weight, "sample_weight")
    if given.ndim == 0:
        given = np.full(n, float(given))
    if given.shape != (n,):
        raise ConformalError(f"sample_weight must have shape ({n},), one weight per row of X, got {given.shape}")
    bad = np.flatnonzero(~(np.isfinite(given) & (given >= 0)))
    if bad.size:
        raise ConformalError(
            f"sample_weight must be finite and at least 0, found {given[bad[0]]:g} at position {bad[0]}"
        )
    if not (given > 0).any():
        raise ConformalError(f"sample_weight must be above zero for a sample at least, all {n} are zero")
    relative = given / given.max()
    return np.asarray(relative / relative[relative > 0].mean())
