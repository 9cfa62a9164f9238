"""The default density: a mixture of residual and direct conditional distributions that takes seconds."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.ensemble import ExtraTreesRegressor
from threadpoolctl import threadpool_limits

from conformodal.conformal.checks import as_count, as_random

from .encoder import TableEncoder
from .forest import LeafForest, group_values, rank_cosines
from .location import Location, boosting, fit_out_of_fold, folds_of, quick_members
from .mixture import MixtureDensity, log_spread, standardised

# seconds of a fit, as measured
_LEAST_SECONDS, _SECONDS_A_NUMBER = 2.0, 4e-6
# (rows, trees): trees of a forest for at most so many rows
_TREES = ((3000, 60), (5000, 40))
_FEWEST_TREES = 30
# held-out rows that choose bandwidths and weights
_VALIDATION_ROWS = 1000


class QuickDensity(MixtureDensity):
    """Conditional density of a value over bins, order-aware, in about the time of a few boostings.

    A smaller :class:`~conformodal.conformal.StackedDensity`. Boosted trees and a forest give every sample an
    out-of-fold location; boosted trees give its spread. Five distributions are mixed by the weights of largest held-out
    likelihood:

    - the marginal distribution of the values;
    - residuals from the location, scaled by the spread, the same for all samples;
    - scaled residuals, weighted by a forest on features and location (:class:`~.forest.LeafForest`);
    - values, weighted by the same forest;
    - values, weighted by a forest on the features alone, for multimodal values, which have no single location.

    Each is smoothed by Gaussian kernels, narrower where values are dense; held-out likelihood chooses the bandwidth.

    Parameters
    ----------
    max_rows
        Rows that are learnt from, drawn at random if there are more.
    random_state, n_jobs
        Seed, or None; parallel jobs of the forests, as in scikit-learn.

    Attributes
    ----------
    edges_ : (K + 1,) edges of the bins
    weights_ : (5,) of the mixture, in the order above

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuickDensity
    >>> rng = np.random.default_rng(0)
    >>> X = rng.random((60, 1))
    >>> y = X[:, 0] + rng.choice([-1, 1], 60)
    >>> density = QuickDensity(random_state=0).fit_bins(X, y, edges=[-1, 0, 1, 2])
    >>> density.predict_proba([[0.5]]).shape
    (1, 3)
    """

    def __init__(self, max_rows: int = 30_000, random_state: Any = None, n_jobs: int | None = None) -> None:
        self.max_rows = max_rows
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit_bins(
        self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None
    ) -> Self:
        """Learn the density of `y` (n,) given `X`, any table (n, p), over bins with `edges` (K + 1,).

        Rows of weight 0 are left out; bandwidths are chosen as if all others weighed the same.
        """
        most, random = as_count(self.max_rows, "max_rows", 2), as_random(self.random_state)
        self.encoder_ = TableEncoder().fit(X)
        table = standardised(self.encoder_.transform(X), y, edges, sample_weight)
        seed = int(random.randint(2**31 - 1))
        if table.z.size > most:
            kept = random.permutation(table.z.size)[:most]
            table.X, table.z, table.weight = table.X[kept], table.z[kept], table.weight[kept]
        features, z, weight, n = table.X, table.z, table.weight, table.z.size
        validation = random.permutation(n)[:_VALIDATION_ROWS]
        n_trees = next((trees for most, trees in _TREES if n <= most), _FEWEST_TREES)
        with threadpool_limits(1):  # waiting threads spin: on a busy core that costs minutes
            values = group_values(z)
            direct = LeafForest(ExtraTreesRegressor, n_trees, 3, seed, self.n_jobs)
            direct.fit(features, rank_cosines(z, 4), z, weight, [values], validation)
            means, members = direct.out_of_bag_mean_, quick_members(n, seed)
            self.location_ = Location().fit(members, features, z, weight, folds_of(n, seed), means)
            summary = self.location_.summary(self.location_.out_of_fold_)
            loc, extended = summary[:, 0], np.column_stack((features, summary))
            rough, folds = boosting(0.1, 40, 8, 20, seed), folds_of(n, seed, most_folds=3)
            log_spreads, self.spread_ = fit_out_of_fold(rough, extended, log_spread(z - loc), weight, folds)
            spread = np.exp(log_spreads)
            scaled = (z - loc) / spread
            residuals = group_values(scaled)
            guided = LeafForest(ExtraTreesRegressor, n_trees, 5, seed + 1, self.n_jobs)
            both = np.column_stack((rank_cosines(scaled, 2), rank_cosines(z, 4)))
            guided.fit(extended, both, z, weight, [residuals, values], validation)
        self.forests_ = guided, direct
        self._mix(table, (loc, spread), (values, residuals), [*guided.out_of_bag_, *direct.out_of_bag_], validation)
        return self

    def expected_seconds(self, n_rows: int, n_features: int) -> float:
        """About how long a fit takes on one core."""
        return _LEAST_SECONDS + _SECONDS_A_NUMBER * min(n_rows, self.max_rows) * n_features
