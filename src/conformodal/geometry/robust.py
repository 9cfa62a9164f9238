"""Robust statistics: normal quantiles, and weights of iteratively reweighted least squares."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray

# Of standard normal variables: the median absolute value; the median length of a vector in two and in three
# dimensions; and the 95th percentile of the latter.
MAD_OF_NORMAL = 0.6745
MEDIAN_OF_NORM2, MEDIAN_OF_NORM3, TAIL_OF_NORM3 = 1.177, 1.5382, 2.7955
# Cauchy's scale in standard deviations: larger residuals get less weight.
_CAUCHY = 2.0


def cauchy(residual: FloatArray) -> FloatArray:
    """Cauchy weights (n,) of residuals in standard deviations."""
    return np.asarray(1 / (1 + (residual / _CAUCHY) ** 2))
