"""Order-aware labels for any classifier, and its probabilities as probabilities of bins."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from conformodal.core import FloatArray, IntArray

from ..checks import as_doubles
from ..errors import ConformalError
from ..scalars import shortened

_COPIES = 4


def _spread_codes(y: FloatArray, edges: FloatArray, sigma_bins: float) -> IntArray:
    """Bin numbers (n, c) of copies of each value, at the mid-quantiles of a Gaussian over bin numbers around it.

    With ``sigma_bins=0`` there is one copy, in the value's own bin. Values beyond the edges count as on them.
    """
    k = edges.size - 1
    at = np.interp(y, edges, np.arange(k + 1))
    offsets = sigma_bins * ndtri((np.arange(_COPIES) + 0.5) / _COPIES) if sigma_bins > 0 else np.zeros(1)
    return np.clip(np.floor(at[:, None] + offsets), 0, k - 1).astype(np.int64)


def fit_classifier(
    model: Any,
    X: npt.NDArray[Any],
    y: FloatArray,
    edges: FloatArray,
    sigma_bins: float,
    weight: FloatArray | None = None,
) -> Any:
    """Fit a classifier on order-aware labels; a target of a single bin needs none, and gives the bin's number."""
    codes = _spread_codes(y, edges, sigma_bins)
    if edges.size == 2 or np.unique(codes).size == 1:
        return int(codes[0, 0])
    with np.errstate(over="ignore", invalid="ignore"):  # scikit-learn tells of its own what overflows
        weights = {} if weight is None else {"sample_weight": np.repeat(weight, codes.shape[1])}
        return model.fit(np.repeat(X, codes.shape[1], axis=0), codes.ravel(), **weights)


def proba_of_bins(model: Any, X: npt.NDArray[Any], n_bins: int) -> FloatArray:
    """Probabilities (n, K) of all bins; a bin that no training value fell in has probability 0."""
    if isinstance(model, int):
        return np.tile(np.arange(n_bins) == model, (X.shape[0], 1)).astype(np.float64)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # scikit-learn tells of its own what overflows
            given = model.predict_proba(X)
    except (ValueError, TypeError) as exc:
        raise ConformalError(f"estimator cannot predict: {shortened(str(exc))}") from exc
    found = as_doubles(given, "predict_proba of the estimator")
    if not hasattr(model, "classes_"):
        return found
    classes = np.asarray(model.classes_, dtype=np.int64)
    if found.shape != (X.shape[0], classes.size):
        raise ConformalError(
            f"predict_proba of the estimator must have shape ({X.shape[0]}, {classes.size}), got {found.shape}"
        )
    proba = np.zeros((X.shape[0], n_bins))
    proba[:, classes] = found
    return proba
