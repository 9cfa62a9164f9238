"""The sharper and slower density: a likelihood-weighted mixture of residual and direct conditional distributions."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import ConvergenceWarning

from conformodal.conformal.checks import as_count, as_random
from conformodal.core.arrays import FloatArray

from .encoder import TableEncoder
from .forest import LeafForest, group_values, rank_cosines
from .location import PROCESS_ROWS, Location, folds_of, stacked_members
from .mixture import MixtureDensity, log_spread, standardised

# seconds of a fit, as measured; the last one counts where a Gaussian process is fitted
_LEAST_SECONDS, _SECONDS_A_ROW, _SECONDS_A_CUBE = 15.0, 4e-3, 1.1e-8


class StackedDensity(MixtureDensity):
    """Conditional density of a value over bins, order-aware; slower and sharper than :class:`QuickDensity`.

    It mixes the same five distributions. Its location is that of boosted trees, random trees, networks and, on small
    tables, a Gaussian process; its spread and the weights of its distributions come from random forests, one for each.

    ``ConformalRegressor("stack")`` uses it. For an example see :class:`QuickDensity`.

    Parameters
    ----------
    n_trees
        Trees of each of the forests.
    random_state, n_jobs
        Seed, or None; parallel jobs of forests and networks, as in scikit-learn.

    Attributes
    ----------
    edges_ : (K + 1,) edges of the bins
    weights_ : (5,) of the mixture, in the order of `QuickDensity`
    """

    def __init__(self, n_trees: int = 100, random_state: Any = None, n_jobs: int | None = None) -> None:
        self.n_trees = n_trees
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit_bins(self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike) -> Self:
        """Learn the density of `y` (n,) given `X`, any table (n, p), over bins with `edges` (K + 1,)."""
        as_count(self.n_trees, "n_trees", 1)
        self.encoder_ = TableEncoder().fit(X)
        table = standardised(self.encoder_.transform(X), y, edges)
        features, z, n = table.X, table.z, table.z.size
        seed = int(as_random(self.random_state).randint(2**31 - 1))
        with warnings.catch_warnings():  # networks stop at their last epoch, rows are in the bags of all trees
            warnings.simplefilter("ignore", ConvergenceWarning)
            warnings.filterwarnings("ignore", message="Some inputs do not have OOB scores")
            warnings.filterwarnings("ignore", category=RuntimeWarning, message="invalid value encountered")
            members, folds = stacked_members(n, seed, self.n_jobs), folds_of(n, seed, 5)
            self.location_ = Location().fit(members, features, z, table.weight, folds)
            summary = self.location_.summary(self.location_.out_of_fold_)
            extended, residual = np.column_stack((features, summary)), z - summary[:, 0]
            self.spread_ = RandomForestRegressor(
                2 * self.n_trees, min_samples_leaf=10, max_features=0.5, random_state=seed, n_jobs=self.n_jobs
            ).set_params(oob_score=_oob_mean)
            self.spread_.fit(extended, log_spread(residual))
        predicted = self.spread_.oob_prediction_
        mean = np.nanmean(predicted) if np.isfinite(predicted).any() else 0.0  # for rows in the bags of all trees
        spread = np.exp(np.where(np.isfinite(predicted), predicted, mean))
        values, residuals = group_values(z), group_values(residual / spread)
        self.forests_ = tuple(
            LeafForest(RandomForestRegressor, self.n_trees, least, seed, self.n_jobs).fit(
                given, rank_cosines(of, 4), of, table.weight, [groups], np.arange(n)
            )
            for least, given, of, groups in (
                (30, extended, residual / spread, residuals),
                (3, extended, z, values),
                (10, features, z, values),
            )
        )
        by_forest = [forest.out_of_bag_[0] for forest in self.forests_]
        self._mix(table, (summary[:, 0], spread), (values, residuals), by_forest, np.arange(n))
        return self

    def expected_seconds(self, n_rows: int, n_features: int) -> float:
        """About how long a fit takes on one core."""
        cubic = n_rows**3 * n_features if n_rows <= PROCESS_ROWS else 0
        return _LEAST_SECONDS + _SECONDS_A_ROW * n_rows + _SECONDS_A_CUBE * cubic


def _oob_mean(truth: FloatArray, predicted: FloatArray) -> float:
    """A dummy score, for which the forest keeps its out-of-bag predictions."""
    return 0.0
