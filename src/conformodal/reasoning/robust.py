"""Weights of iteratively reweighted least squares."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

# Cauchy's scale in standard deviations: residuals beyond it lose their pull.
_CAUCHY = 2.0


def cauchy(residual: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Weights (n,) of residuals in standard deviations."""
    return np.asarray(1 / (1 + (residual / _CAUCHY) ** 2))
