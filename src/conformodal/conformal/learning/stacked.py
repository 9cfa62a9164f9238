"""The slow and sharp density: a likelihood-weighted mixture of residual and direct conditional distributions."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator
from sklearn.ensemble import RandomForestRegressor
from sklearn.exceptions import ConvergenceWarning, NotFittedError

from conformodal.core import FloatArray, IntArray
from conformodal.core.progress import Progress

from ..scalars import as_count, as_random
from .forest import LeafForest, group_values
from .kernels import kernel_masses, log_density, mixture_weights, shifted_masses
from .location import GAUSSIAN_PROCESS_ROWS, StackedLocation
from .standard import as_features, standardised

_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
_GRID_CELLS = 300
_ROWS_AT_ONCE = 4096
# of a fit, as measured; the last where there is a Gaussian process
_LEAST_SECONDS, _SECONDS_A_ROW, _SECONDS_A_CUBE = 15.0, 4e-3, 1.1e-8
# every member keeps a little weight, so that no density is exactly zero and far values can be told apart
_LEAST_WEIGHT = 1e-3


class StackedDensity(BaseEstimator):  # type: ignore[misc]
    """Conditional density of a value over bins, order-aware: neighbouring bins share their evidence.

    A stack of regressors (boosted trees, random trees, networks), predicted out of fold, gives every sample a
    location. Five distributions are then built and mixed by the weights that make held-out values likeliest:

    - the marginal distribution of the values;
    - residuals from the location, scaled by a predicted spread, the same for all samples;
    - scaled residuals, weighted by a forest on features and location (:class:`~.forest.LeafForest`);
    - values, weighted by a forest on features and location: sharp where the location is a good guide;
    - values, weighted by a forest on the features alone: for values that have no location, being here or there.

    Each is smoothed by Gaussian kernels, narrower where values are dense, as wide as held-out likelihood asks.

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

    edges_: FloatArray
    weights_: FloatArray

    def __init__(self, n_trees: int = 100, random_state: Any = None, n_jobs: int | None = None) -> None:
        self.n_trees = n_trees
        self.random_state = random_state
        self.n_jobs = n_jobs

    def fit_bins(
        self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, progress: Progress | None = None
    ) -> Self:
        """Learn the density of `y` (n,) given `X` (n, p) over bins with `edges` (K + 1,).

        `progress` is called with the parts that are done and all parts, nearly all of which are of the location.

        Raises
        ------
        ConformalError
            With fewer than two samples, shapes that do not fit, values that are not finite or too large, or edges that
            do not increase.
        """
        as_count(self.n_trees, "n_trees", 1)
        table = standardised(X, y, edges)
        features, z = table.X, table.z
        self.edges_, self._z_edges = table.edges, table.z_edges
        seed = int(as_random(self.random_state).randint(2**31 - 1))
        codes = table.codes
        widths = np.diff(self._z_edges)

        with _quiet():
            self.location_ = StackedLocation(seed, self.n_jobs).fit(features, z, progress)
        summary = self.location_.summary(self.location_.out_of_fold_)
        extended = np.column_stack((features, summary))
        residual = z - summary[:, 0]
        # a tenth of the median keeps one lucky guess from standing for a spread of zero
        self._least = float(0.1 * np.median(np.abs(residual))) or 1e-6
        self.spread_ = RandomForestRegressor(
            2 * self.n_trees, min_samples_leaf=10, max_features=0.5, random_state=seed, n_jobs=self.n_jobs
        ).set_params(oob_score=_oob_mean)
        with _quiet():
            self.spread_.fit(extended, np.log(np.abs(residual) + self._least))
        spread = np.exp(_filled(self.spread_.oob_prediction_))
        scaled = residual / spread

        self.pooled_values_ = group_values(z), group_values(scaled)
        self.forests_ = [
            LeafForest(30, self.n_trees, seed, self.n_jobs).fit(extended, scaled),
            LeafForest(3, self.n_trees, seed, self.n_jobs).fit(extended, z),
            LeafForest(10, self.n_trees, seed, self.n_jobs).fit(features, z),
        ]
        reach = (scaled.max() - scaled.min()) or 1.0
        ends = np.quantile(scaled, np.linspace(0, 1, _GRID_CELLS + 1))
        self._grid = np.unique(np.concatenate(([ends[0] - reach / 2], ends, [ends[-1] + reach / 2])))
        held_out = [_pooled(g, z.size) for g, _ in self.pooled_values_] + [f.out_of_bag_ for f in self.forests_]
        self._smooth(held_out, z, scaled, summary[:, 0], spread, codes, widths)
        return self

    def _smooth(
        self,
        held_out: list[FloatArray],
        z: FloatArray,
        scaled: FloatArray,
        loc: FloatArray,
        spread: FloatArray,
        codes: IntArray,
        widths: FloatArray,
    ) -> None:
        """Choose every member's bandwidth, then the weights, by the likelihood of held-out values."""
        centers = [self.pooled_values_[0][1], self.pooled_values_[1][1], *(f.values_ for f in self.forests_)]
        self._kernels: list[FloatArray] = []
        likelihoods = []
        for member, (weights, at) in enumerate(zip(held_out, centers, strict=True)):
            best: tuple[float, FloatArray, FloatArray] | None = None
            for factor in _FACTORS:
                edges, sample = (self._grid, scaled) if member in _RESIDUAL else (self._z_edges, z)
                kernel = kernel_masses(at, sample, edges, factor)
                proba = self._member(member, weights, kernel, loc, spread)
                each = log_density(proba, codes, widths)
                if best is None or each.mean() > best[0]:
                    best = float(each.mean()), kernel, each
            assert best is not None
            self._kernels.append(best[1])
            likelihoods.append(best[2])
        mixed = mixture_weights(np.column_stack(likelihoods))
        self.weights_ = np.maximum(mixed, _LEAST_WEIGHT) / np.maximum(mixed, _LEAST_WEIGHT).sum()

    def _member(
        self, member: int, weights: FloatArray, kernel: FloatArray, loc: FloatArray, spread: FloatArray
    ) -> FloatArray:
        masses = weights @ kernel
        if member not in _RESIDUAL:
            return np.broadcast_to(masses, (loc.size, masses.shape[1]))
        masses = np.broadcast_to(masses, (loc.size, masses.shape[1]))
        rows = range(0, loc.size, _ROWS_AT_ONCE)
        cut = [slice(start, start + _ROWS_AT_ONCE) for start in rows]
        return np.concatenate([shifted_masses(masses[r], self._grid, loc[r], spread[r], self._z_edges) for r in cut])

    def expected_seconds(self, n_rows: int, n_features: int) -> float:
        """About how long a fit takes on one core."""
        cubic = n_rows**3 * n_features if n_rows <= GAUSSIAN_PROCESS_ROWS else 0
        return _LEAST_SECONDS + _SECONDS_A_ROW * n_rows + _SECONDS_A_CUBE * cubic

    def predict_proba(self, X: npt.ArrayLike) -> FloatArray:
        """Probabilities of the bins, (n, K)."""
        if not hasattr(self, "weights_"):
            raise NotFittedError("StackedDensity is not fitted yet: call fit_bins(X, y, edges) first")
        features = as_features(X)
        parts = [self._proba(features[i : i + _ROWS_AT_ONCE]) for i in range(0, len(features), _ROWS_AT_ONCE)]
        return np.concatenate(parts) if parts else np.empty((0, self.edges_.size - 1))

    def _proba(self, features: FloatArray) -> FloatArray:
        summary = self.location_.summary(self.location_.predict(features))
        extended = np.column_stack((features, summary))
        spread = np.exp(self.spread_.predict(extended))
        weights = [_pooled(groups, len(groups)) for groups, _ in self.pooled_values_]
        weights += [f.weights(x) for f, x in zip(self.forests_, (extended, extended, features), strict=True)]
        total = np.zeros((len(features), self.edges_.size - 1))
        for member, (w, kernel) in enumerate(zip(weights, self._kernels, strict=True)):
            total += self.weights_[member] * self._member(member, w, kernel, summary[:, 0], spread)
        return np.asarray(total / total.sum(axis=1, keepdims=True))


# the members that are distributions of residuals, by their place in the mixture
_RESIDUAL = (1, 2)


def _pooled(groups: IntArray, n: int) -> FloatArray:
    return (np.bincount(groups) / n)[None]


def _oob_mean(truth: FloatArray, predicted: FloatArray) -> float:
    """The forest's own out-of-bag score is of no use here; asking for one makes it keep the predictions."""
    return 0.0


def _filled(values: FloatArray) -> FloatArray:
    """Samples that no tree left out get the others' mean."""
    return np.where(np.isfinite(values), values, np.nanmean(values) if np.isfinite(values).any() else 0.0)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide what is expected here: networks that stop at their last epoch, samples that no tree left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", message="Some inputs do not have OOB scores")
        warnings.filterwarnings("ignore", category=RuntimeWarning, message="invalid value encountered")
        yield
