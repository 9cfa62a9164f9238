"""Regressors that predict distributions, as learners of densities over bins."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any, Self, TypeAlias

import numpy as np
from sklearn.base import BaseEstimator, clone

from conformodal.conformal.bins import QuantileBins
from conformodal.core.arrays import FloatArray

# of a fitted estimator, rows and the bins of one target: probabilities of the bins (n, K)
Reader: TypeAlias = Callable[[Any, Any, QuantileBins], FloatArray]
_LEVELS = np.linspace(0.005, 0.995, 100)

# Readers by the method that they call, and its argument, in the order in which they are tried. More can be added.
READERS: dict[tuple[str, str], Reader] = {
    ("pred_dist", "X"): lambda model, X, bins: _proba_of(model.pred_dist(X), bins),  # NGBoost
    ("predict_quantiles", "X"): lambda model, X, bins: bins.proba_from_quantiles(
        _LEVELS, model.predict_quantiles(X, _LEVELS.tolist())
    ),
    ("predict", "quantiles"): lambda model, X, bins: bins.proba_from_quantiles(  # quantile-forest
        _LEVELS, model.predict(X, quantiles=_LEVELS.tolist())
    ),
    ("predict", "alphas"): lambda model, X, bins: bins.proba_from_quantiles(  # TabICL
        _LEVELS, model.predict(X, output_type="quantiles", alphas=_LEVELS.tolist())
    ),
}


def _proba_of(distribution: Any, bins: QuantileBins) -> FloatArray:
    """Probabilities of the bins by a distribution's functions ``cdf`` and, if it has one, ``sf``."""
    return bins.proba_from_cdf(distribution.cdf, sf=getattr(distribution, "sf", None))


def reader_of(estimator: Any) -> Reader | None:
    """The reader of an estimator's distributions; None if it predicts none."""
    for (method, argument), reader in READERS.items():
        call = getattr(estimator, method, None)
        if callable(call) and argument in signature(call).parameters:
            return reader
    return None


class DistributionRegressor(BaseEstimator):  # type: ignore[misc]
    """A density over bins from an estimator that predicts distributions; one in ``FrozenEstimator`` is not refitted."""

    def __init__(self, estimator: Any) -> None:
        self.estimator = estimator

    def fit_bins(self, X: Any, y: FloatArray, edges: FloatArray, **options: Any) -> Self:
        """Fit a clone of the estimator; `options` such as ``sample_weight`` are its own."""
        self.bins_ = QuantileBins.from_edges([edges])
        self.model_ = clone(self.estimator)
        self.model_.fit(X, y, **options)
        return self

    def predict_proba(self, X: Any) -> FloatArray:
        """Probabilities (n, K) of the bins."""
        reader = reader_of(self.model_)
        assert reader is not None
        return reader(self.model_, X, self.bins_)
