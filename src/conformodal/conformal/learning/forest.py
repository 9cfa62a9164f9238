"""A forest as a conditional distribution: every sample weighs the training values that share its leaves.

Source: Meinshausen (2006). Unlike there, trees are split on the first cosines of the values' ranks, not on the values
alone, so that a split also answers a change of spread or of the number of modes while the mean stays.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from scipy import sparse
from scipy.stats import rankdata
from sklearn.ensemble import RandomForestRegressor

from conformodal.core.arrays import FloatArray, IntArray

# Values are gathered into at most this many groups of neighbours, which is all the detail a weight can have.
_GROUPS = 256
_COSINES = 4


class LeafForest:
    """Weights over groups of training values.

    Parameters
    ----------
    min_samples_leaf
        Fewest samples in a leaf.
    n_trees, random_state, n_jobs
        Of the forest.

    Attributes
    ----------
    values_ : (G,) mean value of each group
    out_of_bag_ : (n, G) weights of the training samples, by the trees that did not see them; rows sum to one
    """

    values_: FloatArray
    out_of_bag_: FloatArray

    def __init__(self, min_samples_leaf: int, n_trees: int, random_state: int, n_jobs: int | None) -> None:
        self.forest = RandomForestRegressor(
            n_trees, min_samples_leaf=min_samples_leaf, max_features=0.5, random_state=random_state, n_jobs=n_jobs
        )

    def fit(self, X: FloatArray, values: FloatArray) -> Self:
        """Grow the forest on features (n, p) and values (n,)."""
        n = values.size
        groups, self.values_ = group_values(values)
        self.forest.fit(X, rank_cosines(values, _COSINES))
        leaves = self.forest.apply(X)
        member = sparse.csr_array((np.ones(n), (np.arange(n), groups)), (n, self.values_.size))
        self.tables_: list[Any] = []
        weights, seen = np.zeros((n, self.values_.size)), np.zeros(n)
        for tree_leaves, drawn in zip(leaves.T, self.forest.estimators_samples_, strict=True):
            times = np.bincount(drawn, minlength=n).astype(np.float64)
            in_leaf = sparse.csr_array((times, (tree_leaves, np.arange(n))), (tree_leaves.max() + 1, n))
            share = sparse.diags_array(1 / np.maximum(np.asarray(in_leaf.sum(axis=1)).ravel(), 1))
            table = sparse.csr_array(share @ (in_leaf @ member))
            self.tables_.append(table)
            out = np.flatnonzero(times == 0)
            weights[out] += table[tree_leaves[out]].toarray()
            seen[out] += 1
        marginal = np.bincount(groups, minlength=self.values_.size) / n
        self.out_of_bag_ = np.where(seen[:, None] > 0, weights / np.maximum(seen, 1)[:, None], marginal)
        return self

    def weights(self, X: FloatArray) -> FloatArray:
        """Weights of the groups for new samples, (n, G); rows sum to one."""
        total = np.zeros((X.shape[0], self.values_.size))
        for tree_leaves, table in zip(self.forest.apply(X).T, self.tables_, strict=True):
            total += table[tree_leaves].toarray()
        return total / len(self.tables_)


def group_values(values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Group (n,) of every value among at most 256 groups of equal size, and the groups' means (G,)."""
    cuts = np.unique(np.quantile(values, np.linspace(0, 1, _GROUPS + 1)[1:-1]))
    raw = np.searchsorted(cuts, values, side="right")
    _, groups = np.unique(raw, return_inverse=True)
    counts = np.bincount(groups)
    return groups.astype(np.int64), np.bincount(groups, weights=values) / counts


def rank_cosines(values: FloatArray, n_cosines: int) -> FloatArray:
    """The first cosines (n, c) of the values' ranks: splits on them see spread and modes too, not the mean alone."""
    ranks = rankdata(values) / (values.size + 1)
    return np.cos(np.pi * ranks[:, None] * np.arange(1, n_cosines + 1))
