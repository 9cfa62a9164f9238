"""The sharper and slower density: a likelihood-weighted mixture of residual and direct conditional distributions."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import ConvergenceWarning

from conformodal.conformal.scalars import as_count, as_random
from conformodal.core.arrays import FloatArray
from conformodal.core.progress import Progress

from .forest import LeafForest, group_values
from .location import GAUSSIAN_PROCESS_ROWS, StackedLocation
from .mixture import RESIDUAL, MixtureDensity, least_spread
from .standard import standardised

# seconds of a fit, as measured; the last one counts where a Gaussian process is fitted
_LEAST_SECONDS, _SECONDS_A_ROW, _SECONDS_A_CUBE = 15.0, 4e-3, 1.1e-8


class StackedDensity(MixtureDensity):
    """Conditional density of a value over bins, order-aware; slower and sharper than :class:`QuickDensity`.

    A stack of regressors (boosted trees, random trees, networks) gives every sample an out-of-fold location. Five
    distributions are mixed by the weights of largest held-out likelihood:

    - the marginal distribution of the values;
    - residuals from the location, scaled by a predicted spread, the same for all samples;
    - scaled residuals, weighted by a forest on features and location (:class:`~.forest.LeafForest`);
    - values, weighted by a forest on features and location;
    - values, weighted by a forest on the features alone, for multimodal values, which have no single location.

    Each is smoothed by Gaussian kernels, narrower where values are dense; held-out likelihood chooses the bandwidth.

    ``ConformalRegressor("stack")`` uses it. For an example see :class:`QuickDensity`.

    Parameters
    ----------
    n_trees
        Trees of each of the forests.
    random_state
        Seed, or None.
    n_jobs
        Parallel jobs of forests and networks, as in scikit-learn.

    Attributes
    ----------
    edges_ : (K + 1,) edges of the bins
    weights_ : (5,) of the mixture, in the order above
    """

    _rows_at_once = 4096

    def __init__(self, n_trees: int = 100, random_state: Any = None, n_jobs: int | None = None) -> None:
        self.n_trees = n_trees
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit_bins(
        self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, progress: Progress | None = None
    ) -> Self:
        """Learn the density of `y` (n,) given `X` (n, p) over bins with `edges` (K + 1,).

        `progress` is called with the parts that are done and all parts, nearly all of which are of the location.
        """
        as_count(self.n_trees, "n_trees", 1)
        table = standardised(X, y, edges)
        features, z = table.X, table.z
        seed = int(as_random(self.random_state).randint(2**31 - 1))

        with _quiet():
            self.location_ = StackedLocation(seed, self.n_jobs).fit(features, z, progress)
        summary = self.location_.summary(self.location_.out_of_fold_)
        extended = np.column_stack((features, summary))
        residual = z - summary[:, 0]
        self.spread_ = RandomForestRegressor(
            2 * self.n_trees, min_samples_leaf=10, max_features=0.5, random_state=seed, n_jobs=self.n_jobs
        ).set_params(oob_score=_oob_mean)
        with _quiet():
            self.spread_.fit(extended, np.log(np.abs(residual) + least_spread(residual)))
        spread = np.exp(_filled(self.spread_.oob_prediction_))
        scaled = residual / spread

        self.forests_ = [
            LeafForest(30, self.n_trees, seed, self.n_jobs).fit(extended, scaled),
            LeafForest(3, self.n_trees, seed, self.n_jobs).fit(extended, z),
            LeafForest(10, self.n_trees, seed, self.n_jobs).fit(features, z),
        ]
        by_forest = [forest.out_of_bag_ for forest in self.forests_]
        groups = group_values(z), group_values(scaled)
        self._mix(table, (summary[:, 0], spread), groups, by_forest, np.arange(z.size))
        return self

    def expected_seconds(self, n_rows: int, n_features: int) -> float:
        """About how long a fit takes on one core."""
        cubic = n_rows**3 * n_features if n_rows <= GAUSSIAN_PROCESS_ROWS else 0
        return _LEAST_SECONDS + _SECONDS_A_ROW * n_rows + _SECONDS_A_CUBE * cubic

    def _proba(self, features: FloatArray) -> FloatArray:
        summary = self.location_.summary(self.location_.predict(features))
        extended = np.column_stack((features, summary))
        spread = np.exp(self.spread_.predict(extended))
        weights = [*self._pooled]
        weights += [f.weights(x) for f, x in zip(self.forests_, (extended, extended, features), strict=True)]
        total = np.zeros((len(features), self.edges_.size - 1))
        for share, residual, w, kernel in zip(self.weights_, RESIDUAL, weights, self._kernels, strict=True):
            masses = np.broadcast_to(w @ kernel, (len(features), kernel.shape[1]))
            total += share * (self._shifted(masses, summary[:, 0], spread) if residual else masses)
        return np.asarray(total / total.sum(axis=1, keepdims=True))


def _oob_mean(truth: FloatArray, predicted: FloatArray) -> float:
    """A dummy score, for which the forest keeps its out-of-bag predictions."""
    return 0.0


def _filled(values: FloatArray) -> FloatArray:
    """Out-of-bag predictions; a sample that every tree was grown on gets the mean of the others."""
    return np.where(np.isfinite(values), values, np.nanmean(values) if np.isfinite(values).any() else 0.0)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide expected warnings of networks that stop at their last epoch and of samples without out-of-bag trees."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", message="Some inputs do not have OOB scores")
        warnings.filterwarnings("ignore", category=RuntimeWarning, message="invalid value encountered")
        yield
