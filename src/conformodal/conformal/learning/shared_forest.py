"""One forest whose leaves weigh several kinds of training values, by sparse products.

As :mod:`.forest`, for less time: trees are split at random cuts, values of several kinds share them, and weights out
of bag are worked out for the rows that are asked for.
"""

from __future__ import annotations

from typing import Any, Self, TypeAlias

import numpy as np
from scipy import sparse
from sklearn.ensemble import ExtraTreesRegressor

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

# the group (n,) that every training value is in, and the number of groups
Grouping: TypeAlias = tuple[IntArray, int]


class SharedForest:
    """Weights over groups of training values, from extremely randomised trees on bootstrap samples.

    Source: Geurts, Ernst and Wehenkel (2006); Meinshausen (2006).

    Parameters
    ----------
    n_trees, min_samples_leaf, random_state, n_jobs
        Of the forest.

    Attributes
    ----------
    out_of_bag_ : one (m, G) a grouping: weights of the asked rows by trees that did not see them; rows sum to one
    out_of_bag_mean_ : (n,) mean of the values by trees that did not see the row
    """

    out_of_bag_: list[FloatArray]
    out_of_bag_mean_: FloatArray

    def __init__(self, n_trees: int, min_samples_leaf: int, random_state: int, n_jobs: int | None) -> None:
        self.forest = ExtraTreesRegressor(
            n_trees,
            min_samples_leaf=min_samples_leaf,
            max_features=0.5,
            bootstrap=True,
            random_state=random_state,
            n_jobs=n_jobs,
        )

    def fit(
        self,
        X: FloatArray,
        targets: FloatArray,
        values: FloatArray,
        weight: FloatArray,
        groupings: list[Grouping],
        rows: IntArray,
    ) -> Self:
        """Grow on features (n, p) and what to split by (n, c); average `values` and gather `groupings` in leaves."""
        n = values.size
        self.forest.fit(X, targets)  # what it does with weights differs between versions: here leaves are weighted
        nodes = [tree.tree_.node_count for tree in self.forest.estimators_]
        self._first = np.concatenate(([0], np.cumsum(nodes)))
        leaves = self.apply(X)
        times = np.column_stack([np.bincount(drawn, minlength=n) for drawn in self.forest.estimators_samples_])
        row, tree = np.nonzero(times)
        parts = (times * weight[:, None])[row, tree], (leaves[row, tree], row)
        drawn = sparse.csr_array(parts, (int(self._first[-1]), n))
        share = 1 / np.maximum(np.asarray(drawn.sum(axis=1)).ravel(), 1e-300)
        drawn = sparse.csr_array(sparse.diags_array(np.where(share < 1e300, share, 0.0)) @ drawn)
        self._means = np.asarray(drawn @ values)
        self._tables: list[Any] = []
        for groups, size in groupings:
            member = sparse.csr_array((np.ones(n), (np.arange(n), groups)), (n, size))
            self._tables.append(sparse.csr_array(drawn @ member))

        out = times == 0
        count = out.sum(axis=1)
        total = np.where(out, self._means[leaves], 0.0).sum(axis=1)
        self.out_of_bag_mean_ = np.where(count > 0, total / np.maximum(count, 1), np.average(values, weights=weight))
        query = self._query(leaves[rows], out[rows])
        self.out_of_bag_ = []
        for table, (groups, size) in zip(self._tables, groupings, strict=True):
            pooled = np.bincount(groups, weight, minlength=size) / weight.sum()
            self.out_of_bag_.append(np.where(count[rows, None] > 0, (query @ table).toarray(), pooled))
        return self

    def apply(self, X: FloatArray) -> IntArray:
        """Leaves (n, t) of samples, numbered through all trees."""
        return np.asarray(self.forest.apply(X) + self._first[:-1], dtype=np.int64)

    def means(self, leaves: IntArray) -> FloatArray:
        """Means (n,) of the training values in `leaves`."""
        return np.asarray(self._means[leaves].mean(axis=1))

    def weights(self, leaves: IntArray) -> list[FloatArray]:
        """Weights (n, G) of the groups in `leaves`, one array a grouping; rows sum to one."""
        query = self._query(leaves, np.ones(leaves.shape, dtype=np.bool_))
        return [np.asarray((query @ table).toarray()) for table in self._tables]

    def _query(self, leaves: IntArray, counted: BoolArray) -> Any:
        row, tree = np.nonzero(counted)
        share = 1 / np.maximum(counted.sum(axis=1), 1)
        return sparse.csr_array((share[row], (row, leaves[row, tree])), (len(leaves), int(self._first[-1])))
