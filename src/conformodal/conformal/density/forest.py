"""Forests as conditional distributions: training values are weighted by how often they share leaves with a sample.

Source: Meinshausen (2006). Unlike there, trees are split on the first cosines of the values' ranks, so that splits
respond to changes of the spread or of the number of modes, not only of the mean.
"""

from __future__ import annotations

from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.stats import rankdata

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

# Values are gathered into at most this many groups of neighbours, which is all the detail a weight can have.
_GROUPS = 256
# the group (n,) of every training value, and the means of the groups' values (G,)
Groups: TypeAlias = tuple[IntArray, FloatArray]


class LeafForest:
    """Weights over several groupings of training values, which share the trees; `kind` is a forest of scikit-learn.

    `out_of_bag_` holds, per grouping, the weights (m, G) of the requested rows by trees that did not see them;
    `out_of_bag_mean_` (n,) is the mean of the values by trees that did not see the row.
    """

    def __init__(self, kind: Any, n_trees: int, min_samples_leaf: int, random_state: int) -> None:
        options = {"min_samples_leaf": min_samples_leaf, "max_features": 0.5, "bootstrap": True}
        self.forest = kind(n_trees, random_state=random_state, **options)

    def fit(
        self,
        X: FloatArray,
        splits: FloatArray,
        y: FloatArray,
        weight: FloatArray,
        groupings: list[Groups],
        rows: IntArray,
    ) -> Self:
        """Fit on features (n, p) and what trees split by (n, c); average values `y` and `groupings` in the leaves."""
        n = y.size
        self.forest.fit(X, splits)  # what it does with weights differs between versions: here leaves are weighted
        nodes = [tree.tree_.node_count for tree in self.forest.estimators_]
        self._first = np.concatenate(([0], np.cumsum(nodes)))
        leaves = self.apply(X)
        times = np.column_stack([np.bincount(drawn, minlength=n) for drawn in self.forest.estimators_samples_])
        row, tree = np.nonzero(times)
        parts = (times * weight[:, None])[row, tree], (leaves[row, tree], row)
        drawn = sparse.csr_array(parts, (int(self._first[-1]), n))
        share = 1 / np.maximum(np.asarray(drawn.sum(axis=1)).ravel(), 1e-300)
        drawn = sparse.csr_array(sparse.diags_array(np.where(share < 1e300, share, 0.0)) @ drawn)
        self._means = np.asarray(drawn @ y)

        out = times == 0
        count = out.sum(axis=1)
        total = np.where(out, self._means[leaves], 0.0).sum(axis=1)
        self.out_of_bag_mean_ = np.where(count > 0, total / np.maximum(count, 1), np.average(y, weights=weight))
        query = self._query(leaves[rows], out[rows])
        self._tables: list[Any] = []
        self.out_of_bag_ = []
        for groups, means in groupings:
            member = sparse.csr_array((np.ones(n), (np.arange(n), groups)), (n, means.size))
            self._tables.append(sparse.csr_array(drawn @ member))
            pooled = np.bincount(groups, weight, minlength=means.size) / weight.sum()
            self.out_of_bag_.append(np.where(count[rows, None] > 0, (query @ self._tables[-1]).toarray(), pooled))
        return self

    def apply(self, X: FloatArray) -> IntArray:
        """Leaves (n, t) of samples, numbered over all trees."""
        inputs = _as_tree_inputs(X)
        leaves = np.empty((len(inputs), len(self.forest.estimators_)), dtype=np.int64)
        for tree, first, column in zip(self.forest.estimators_, self._first, leaves.T, strict=False):
            np.add(tree.tree_.apply(inputs), first, out=column)
        return leaves

    def alike(self, X: FloatArray) -> IntArray:
        """An order (n,) of samples in which neighbours are alike: by their leaves in the first tree."""
        return np.argsort(self.forest.estimators_[0].tree_.apply(_as_tree_inputs(X)), kind="stable")

    def means(self, leaves: IntArray) -> FloatArray:
        """Means (n,) of the training values in `leaves`."""
        return np.asarray(self._means[leaves].mean(axis=1))

    @property
    def n_groupings(self) -> int:
        """Groupings of training values that the trees share."""
        return len(self._tables)

    def projection(self, bases: list[FloatArray]) -> LeafProjection:
        """Weights of the groups of every grouping times its basis (G, r), side by side."""
        return LeafProjection(self._tables, bases)

    def _query(self, leaves: IntArray, counted: BoolArray) -> Any:
        row, tree = np.nonzero(counted)
        share = 1 / np.maximum(counted.sum(axis=1), 1)
        return sparse.csr_array((share[row], (row, leaves[row, tree])), (len(leaves), int(self._first[-1])))


class LeafProjection:
    """Weights over groups of training values, in a basis per grouping: a mean of one vector per leaf.

    Weights of 256 groups that are smoothed by a wide kernel are known from a tenth as many numbers. These are kept in
    float32, for leaves only: `tables` hold no values for the inner nodes of trees.
    """

    def __init__(self, tables: list[Any], bases: list[FloatArray]) -> None:
        inhabited = np.flatnonzero(np.diff(tables[0].indptr))
        self._place = np.zeros(tables[0].shape[0], dtype=np.int32)
        self._place[inhabited] = np.arange(inhabited.size)
        parts = [table[inhabited] @ basis for table, basis in zip(tables, bases, strict=True)]
        self._vectors = np.hstack(parts).astype(np.float32)

    def __call__(self, leaves: IntArray) -> FloatArray:
        """Projected weights (n, r) of samples in `leaves` (n, t), of which each tree has one."""
        n, n_trees = leaves.shape
        share, ends = np.full(leaves.size, 1 / n_trees, np.float32), np.arange(0, leaves.size + 1, n_trees)
        query = sparse.csr_array((share, self._place[leaves].ravel(), ends.astype(np.int32)), (n, len(self._vectors)))
        return np.asarray(query @ self._vectors, dtype=np.float64)


def _as_tree_inputs(X: FloatArray) -> npt.NDArray[np.float32]:
    with np.errstate(over="ignore"):  # refused below
        inputs = np.ascontiguousarray(X, dtype=np.float32)
    if not np.isfinite(inputs).all():
        raise ValueError("inputs must be numbers that float32 can hold")
    return inputs


def group_values(values: FloatArray) -> Groups:
    """Group (n,) of every value among at most 256 groups of equal size, and the means of the groups (G,)."""
    cuts = np.unique(np.quantile(values, np.linspace(0, 1, _GROUPS + 1)[1:-1]))
    raw = np.searchsorted(cuts, values, side="right")
    _, groups = np.unique(raw, return_inverse=True)
    counts = np.bincount(groups)
    return groups.astype(np.int64), np.bincount(groups, weights=values) / counts


def rank_cosines(values: FloatArray, n_cosines: int) -> FloatArray:
    """The first cosines (n, c) of the ranks of values."""
    ranks = rankdata(values) / (values.size + 1)
    return np.cos(np.pi * ranks[:, None] * np.arange(1, n_cosines + 1))
