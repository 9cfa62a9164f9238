"""A stack of regressors with out-of-fold predictions of the training data."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.ensemble import BaggingRegressor, ExtraTreesRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from conformodal.core.arrays import FloatArray
from conformodal.core.progress import Progress

from .quick_location import Location, boosting

_FOLDS = 5
_NETWORKS = 3
# gradient steps of a network: rows times epochs, within limits
_ROWS_SEEN = 600_000
# beyond so many rows a Gaussian process, whose cost is cubic, is left out
GAUSSIAN_PROCESS_ROWS = 1500


class StackedLocation(Location):
    """Boosted trees, random trees, networks and, on small tables, a Gaussian process."""

    def __init__(self, random_state: int, n_jobs: int | None) -> None:
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit(self, X: FloatArray, y: FloatArray, progress: Progress | None = None) -> Self:
        """Fit on features (n, p) and values (n,) of about unit spread; `progress` is called after every fit."""
        members = self._members(y.size)
        n_folds = min(_FOLDS, y.size)
        total, done = (n_folds + 1) * len(members), 0

        def fitted(member: Any, rows: Any) -> Any:
            nonlocal done
            member.fit(X[rows], y[rows])
            done += 1
            if progress is not None:
                progress(done, total)
            return member

        out_of_fold = np.empty((y.size, len(members)))
        folds = KFold(n_folds, shuffle=True, random_state=self.random_state)
        for seen, left_out in folds.split(X):
            for j, member in enumerate(members):
                out_of_fold[left_out, j] = fitted(clone(member), seen).predict(X[left_out])
        self._weigh(out_of_fold, y, np.ones(y.size))
        self.members_ = [fitted(member, slice(None)) for member in members]
        return self

    def predict(self, X: FloatArray) -> FloatArray:
        """Predictions of all members, (n, m)."""
        return np.column_stack([member.predict(X) for member in self.members_])

    def _members(self, n: int) -> list[Any]:
        seed = self.random_state

        def networks(decay: float, rate: float) -> Any:
            one = MLPRegressor(
                hidden_layer_sizes=(64, 64),
                alpha=decay,
                learning_rate_init=rate,
                max_iter=int(np.clip(_ROWS_SEEN // n, 30, 400)),
                n_iter_no_change=1000,  # no early stopping: the folds of the stack guard against overfitting
                random_state=seed,
            )
            bag = BaggingRegressor(one, _NETWORKS, bootstrap=False, n_jobs=self.n_jobs, random_state=seed)
            return make_pipeline(StandardScaler(), bag)

        trees = ExtraTreesRegressor(200, n_jobs=self.n_jobs, random_state=seed)
        boosters = [boosting(0.05, 500, 31, 10, seed)(), boosting(0.05, 1000, 8, 5, seed)()]
        members = [*boosters, trees, networks(1e-3, 5e-3), networks(0.1, 1e-2)]
        if n <= GAUSSIAN_PROCESS_ROWS:
            members.append(make_pipeline(StandardScaler(), _AnisotropicProcess()))
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
