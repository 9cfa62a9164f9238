"""A density over bins as a mixture of five smoothed distributions, weighted by held-out likelihood."""

from __future__ import annotations

from abc import abstractmethod
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from sklearn.base import BaseEstimator
from sklearn.exceptions import NotFittedError

from conformodal.core.arrays import FloatArray, IntArray

from .kernels import kernel_masses, log_density, mixture_weights, shifted_masses
from .standard import Standardised, as_features

# the group (n,) of every training value, and the groups' means (G,); see group_values
Groups: TypeAlias = tuple[IntArray, FloatArray]

# for each of the five components, in order: whether it is a distribution of scaled residuals
RESIDUAL = (False, True, True, False, False)
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
_GRID_CELLS = 300
# least weight of a component, so that no density is exactly zero and far values differ
_LEAST_WEIGHT = 1e-3


class MixtureDensity(BaseEstimator):  # type: ignore[misc]
    """What the quick and the stacked density share: smoothing, mixing and prediction in blocks of rows.

    The components, in order: the marginal distribution of the values, that of the scaled residuals, and three whose
    weights a forest gives for each sample (one over scaled residuals, two over values).
    """

    edges_: FloatArray
    weights_: FloatArray
    _rows_at_once: int

    def predict_proba(self, X: npt.ArrayLike) -> FloatArray:
        """Probabilities of the bins, (n, K)."""
        if not hasattr(self, "weights_"):
            raise NotFittedError(f"{type(self).__name__} is not fitted yet: call fit_bins(X, y, edges) first")
        features, step = as_features(X), self._rows_at_once
        parts = [self._proba(features[i : i + step]) for i in range(0, len(features), step)]
        return np.concatenate(parts) if parts else np.empty((0, self.edges_.size - 1))

    @abstractmethod
    def _proba(self, features: FloatArray) -> FloatArray:
        """Probabilities of the bins for a block of rows."""

    def _mix(
        self,
        table: Standardised,
        place: tuple[FloatArray, FloatArray],
        groups: tuple[Groups, Groups],
        by_forest: list[FloatArray],
        validation: IntArray,
    ) -> None:
        """Choose every component's bandwidth, then the weights, by the likelihood of held-out values.

        `place` are location and spread (n,) of every row, out of fold; `groups` are of the values and of the scaled
        residuals; `by_forest` are the out-of-bag weights (m, G) of the three forests for the `validation` rows (m,).
        """
        loc, spread = place
        scaled = (table.z - loc) / spread
        self._z_edges, self._grid = table.z_edges, _grid_of(scaled)
        self._pooled = [np.bincount(of, table.weight)[None] / table.weight.sum() for of, _ in groups]
        codes, widths, weight = table.codes[validation], np.diff(table.z_edges), table.weight[validation]
        self._kernels: list[FloatArray] = []
        likelihoods = []
        for residual, weights in zip(RESIDUAL, [*self._pooled, *by_forest], strict=True):
            centers, sample, edges = (
                (groups[1][1], scaled, self._grid) if residual else (groups[0][1], table.z, table.z_edges)
            )
            found = []
            for factor in _FACTORS:
                kernel = kernel_masses(centers, sample, edges, factor)
                masses = np.broadcast_to(weights @ kernel, (validation.size, edges.size - 1))
                proba = self._shifted(masses, loc[validation], spread[validation]) if residual else masses
                each = log_density(proba, codes, widths)
                found.append((float(np.average(each, weights=weight)), kernel, each))
            _, kernel, each = max(found, key=lambda one: one[0])
            self._kernels.append(kernel)
            likelihoods.append(each)
        mixed = np.maximum(mixture_weights(np.column_stack(likelihoods), weight), _LEAST_WEIGHT)
        self.edges_, self.weights_ = table.edges, mixed / mixed.sum()

    def _shifted(self, masses: FloatArray, loc: FloatArray, spread: FloatArray) -> FloatArray:
        """Bin probabilities of values, from masses (n, M) of their scaled residuals."""
        step = self._rows_at_once
        rows = [slice(start, start + step) for start in range(0, loc.size, step)]
        return np.concatenate([shifted_masses(masses[r], self._grid, loc[r], spread[r], self._z_edges) for r in rows])


def least_spread(residual: FloatArray) -> float:
    """A tenth of the median residual: a lower bound, so that one accurate prediction does not give a spread of zero."""
    return float(0.1 * np.median(np.abs(residual))) or 1e-6


def _grid_of(scaled: FloatArray) -> FloatArray:
    """Cells with equal numbers of scaled residuals, and one beyond them at either end."""
    reach = (scaled.max() - scaled.min()) or 1.0
    ends = np.quantile(scaled, np.linspace(0, 1, _GRID_CELLS + 1))
    return np.unique(np.concatenate(([ends[0] - reach / 2], ends, [ends[-1] + reach / 2])))
