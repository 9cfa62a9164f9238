"""Regressors, stacked to predict the location of a value, in and out of fold."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Self, TypeAlias

import numpy as np
from scipy.optimize import nnls
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import BaggingRegressor, ExtraTreesRegressor, HistGradientBoostingRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from conformodal.core.arrays import FloatArray, IntArray

Maker: TypeAlias = Callable[[], Any]
Folds: TypeAlias = list[tuple[IntArray, IntArray]]

# (rows, folds): folds for at most so many rows
_FOLDS = ((1500, 5), (8000, 3))
_FEWEST_FOLDS = 2
# a second boosting, of smaller trees, is fitted on at most so many rows
_SECOND_ROWS = 700
# the Gaussian process of the stack is fitted on at most so many rows
PROCESS_ROWS = 1500
# networks of the stack; gradient steps of each: rows times epochs, within limits
_NETWORKS, _ROWS_SEEN = 3, 600_000


class Location:
    """Predictions of the location of a value, weighted by non-negative least squares (Breiman 1996).

    Attributes
    ----------
    out_of_fold_ : (n, m) predictions of every training value by models that did not see it
    weights_ : (m,), sum to one
    """

    out_of_fold_: FloatArray
    weights_: FloatArray

    def fit(
        self,
        members: list[Maker],
        X: FloatArray,
        y: FloatArray,
        weight: FloatArray,
        folds: Folds,
        forest: FloatArray | None = None,
    ) -> Self:
        """Fit on features (n, p), values (n,) of about unit spread and weights.

        `members` make untrained regressors. `forest` (n,) are out-of-bag means of a forest, one more member.
        """
        fits = [fit_out_of_fold(member, X, y, weight, folds) for member in members]
        self._models = [model for _, model in fits]
        self._with_forest = forest is not None
        self.out_of_fold_ = np.column_stack([*(guess for guess, _ in fits), *([] if forest is None else [forest])])
        root = np.sqrt(weight)
        raw, _ = nnls(self.out_of_fold_ * root[:, None], y * root)
        self.weights_ = raw / raw.sum() if raw.sum() > 0 else np.full(raw.size, 1 / raw.size)
        return self

    def predict(self, X: FloatArray, forest: FloatArray) -> FloatArray:
        """:meth:`summary` of the predictions for new samples; `forest` are the forest's means (n,)."""
        predictions = [model.predict(X) for model in self._models]
        return self.summary(np.column_stack([*predictions, forest] if self._with_forest else predictions))

    def summary(self, predictions: FloatArray) -> FloatArray:
        """The weighted mean and the standard deviation of the members' predictions (n, m), as (n, 2)."""
        return np.column_stack((predictions @ self.weights_, predictions.std(axis=1)))


def quick_members(n: int, seed: int) -> list[Maker]:
    """Boosted trees, on small tables of two kinds."""
    members = [boosting(0.15, 150, 15, 5, seed)]
    if n <= _SECOND_ROWS:
        members.append(boosting(0.1, 300, 8, 5, seed))
    return members


def stacked_members(n: int, seed: int, n_jobs: int | None) -> list[Maker]:
    """Boosted trees, random trees, networks and, on small tables, an exact Gaussian process."""

    def networks(decay: float, rate: float) -> Maker:
        one = MLPRegressor(
            hidden_layer_sizes=(64, 64),
            alpha=decay,
            learning_rate_init=rate,
            max_iter=int(np.clip(_ROWS_SEEN // n, 30, 400)),
            n_iter_no_change=1000,  # no early stopping: the folds of the stack guard against overfitting
            random_state=seed,
        )
        options: Any = {"bootstrap": False, "n_jobs": n_jobs, "random_state": seed}
        return lambda: make_pipeline(StandardScaler(), BaggingRegressor(one, _NETWORKS, **options))

    def trees() -> Any:
        return ExtraTreesRegressor(200, n_jobs=n_jobs, random_state=seed)

    boosters = [boosting(0.05, 500, 31, 10, seed), boosting(0.05, 1000, 8, 5, seed)]
    members = [*boosters, trees, networks(1e-3, 5e-3), networks(0.1, 1e-2)]
    if n <= PROCESS_ROWS:
        members.append(lambda: make_pipeline(StandardScaler(), _AnisotropicProcess()))
    return members


class _AnisotropicProcess(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Gaussian process with one length scale per feature (Rasmussen and Williams 2006, chapter 5)."""

    def fit(self, X: FloatArray, y: FloatArray) -> Self:
        kernel = ConstantKernel(1.0) * Matern(np.ones(X.shape[1]), nu=1.5) + WhiteKernel(0.05)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a useless feature's length scale runs to its bound
            self.process_ = GaussianProcessRegressor(kernel, normalize_y=True).fit(X, y)
        return self

    def predict(self, X: FloatArray) -> FloatArray:
        return np.asarray(self.process_.predict(X))


def folds_of(n: int, random_state: int, n_folds: int | None = None, most_folds: int = 5) -> Folds:
    """Folds of `n` rows, at least 2: by default fewer for many rows."""
    n_folds = n_folds or next((folds for most, folds in _FOLDS if n <= most), _FEWEST_FOLDS)
    return list(KFold(min(n_folds, most_folds, n), shuffle=True, random_state=random_state).split(np.empty((n, 1))))


def boosting(rate: float, rounds: int, leaves: int, least: int, random_state: int) -> Maker:
    """A factory of untrained boosted trees."""
    return lambda: HistGradientBoostingRegressor(
        learning_rate=rate,
        max_iter=rounds,
        max_leaf_nodes=leaves,
        min_samples_leaf=least,
        l2_regularization=1.0,
        max_features=0.5,
        early_stopping=False,
        random_state=random_state,
    )


def fit_out_of_fold(
    make: Maker, X: FloatArray, y: FloatArray, weight: FloatArray, folds: Folds
) -> tuple[FloatArray, Any]:
    """Out-of-fold predictions (n,), and a model of all rows."""

    def fitted(rows: Any) -> Any:
        # boosting takes several times as long with weights, equal ones too
        share = {"sample_weight": weight[rows]} if np.ptp(weight) else {}
        return make().fit(X[rows], y[rows], **share)

    predictions = np.empty(y.size)
    for train, left_out in folds:
        predictions[left_out] = fitted(train).predict(X[left_out])
    return predictions, fitted(slice(None))
