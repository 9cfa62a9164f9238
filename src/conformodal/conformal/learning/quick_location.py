"""Boosted trees, a Gaussian process and a forest, stacked to predict the location of a value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from scipy.optimize import nnls
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.model_selection import KFold

from conformodal.core.arrays import FloatArray

from .process import Folds, SparseProcess

# (rows, folds): folds for at most so many rows
_FOLDS = ((1500, 5), (8000, 3))
_FEWEST_FOLDS = 2
# a second boosting, of smaller trees, is fitted on at most so many rows
_SECOND_ROWS = 700
# the Gaussian process is fitted on at most so many rows
_PROCESS_ROWS = 10_000


class Location:
    """Predictions of the location of a value, weighted by non-negative least squares (Breiman 1996).

    Attributes
    ----------
    out_of_fold_ : (n, m) predictions of every training value by models that did not see it
    weights_ : (m,), sum to one
    """

    out_of_fold_: FloatArray
    weights_: FloatArray

    def _weigh(self, out_of_fold: FloatArray, y: FloatArray, weight: FloatArray) -> None:
        root = np.sqrt(weight)
        weights, _ = nnls(out_of_fold * root[:, None], y * root)
        self.out_of_fold_ = out_of_fold
        self.weights_ = weights / weights.sum() if weights.sum() > 0 else np.full(weights.size, 1 / weights.size)

    def summary(self, predictions: FloatArray) -> FloatArray:
        """The weighted mean and the standard deviation of the predictions (n, m), as (n, 2)."""
        return np.column_stack((predictions @ self.weights_, predictions.std(axis=1)))


class QuickLocation(Location):
    """Boosting, :class:`~.process.SparseProcess` and out-of-bag means of a forest."""

    def __init__(self, random_state: int) -> None:
        self.random_state = random_state

    def fit(self, X: FloatArray, y: FloatArray, weight: FloatArray, forest: FloatArray) -> Self:
        """Fit on features (n, p), values (n,) of about unit spread, weights and the means `forest` (n,)."""
        folds = folds_of(y.size, self.random_state)
        out_of_fold, self._models = [], []
        boosters = [boosting(0.15, 150, 15, 5, self.random_state)]
        if y.size <= _SECOND_ROWS:
            boosters.append(boosting(0.1, 300, 8, 5, self.random_state))
        for make in boosters:
            guess, model = fit_out_of_fold(make, X, y, weight, folds)
            out_of_fold.append(guess)
            self._models.append(model)
        if y.size <= _PROCESS_ROWS:
            try:
                process = SparseProcess(self.random_state).fit(X, y, weight, folds)
                out_of_fold.append(process.out_of_fold_)
                self._models.append(process)
            except np.linalg.LinAlgError:  # the others remain
                pass
        self._weigh(np.column_stack([*out_of_fold, forest]), y, weight)
        return self

    def predict(self, X: FloatArray, forest: FloatArray) -> FloatArray:
        """Predictions of all members, (n, m); `forest` are the means (n,) of the forest."""
        return np.column_stack([*(model.predict(X) for model in self._models), forest])


def folds_of(n: int, random_state: int, most_folds: int = 5) -> Folds:
    """Folds of `n` rows, at least 2: fewer for many rows."""
    n_folds = next((folds for most, folds in _FOLDS if n <= most), _FEWEST_FOLDS)
    return list(KFold(min(n_folds, most_folds, n), shuffle=True, random_state=random_state).split(np.empty((n, 1))))


def boosting(rate: float, rounds: int, leaves: int, least: int, random_state: int) -> Callable[[], Any]:
    """A factory of untrained boosted trees."""

    def make() -> Any:
        return HistGradientBoostingRegressor(
            learning_rate=rate,
            max_iter=rounds,
            max_leaf_nodes=leaves,
            min_samples_leaf=least,
            l2_regularization=1.0,
            max_features=0.5,
            early_stopping=False,
            random_state=random_state,
        )

    return make


def fit_out_of_fold(
    make: Callable[[], Any], X: FloatArray, y: FloatArray, weight: FloatArray, folds: Folds
) -> tuple[FloatArray, Any]:
    """Out-of-fold predictions (n,), and a model of all rows."""
    found = np.empty(y.size)
    # boosting takes several times as long with weights, equal ones too
    some: list[FloatArray | None] = [weight[seen] if np.ptp(weight) else None for seen, _ in folds]
    for (seen, left_out), share in zip(folds, some, strict=True):
        found[left_out] = make().fit(X[seen], y[seen], sample_weight=share).predict(X[left_out])
    return found, make().fit(X, y, sample_weight=weight if np.ptp(weight) else None)
