import numpy as np
from sklearn.ensemble import ExtraTreesRegressor

from conformodal.conformal.learning.forest import LeafForest, group_values, rank_cosines


def grown(weight):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (300, 2))
    y = X[:, 0] + 0.1 * rng.standard_normal(300)
    groups, at = group_values(y)
    forest = LeafForest(ExtraTreesRegressor, 20, 5, 0, None)
    rows = np.arange(0, 300, 3)
    return forest.fit(X, rank_cosines(y, 4), y, weight, [(groups, at)], rows), X, y, groups, rows


def test_weights_are_those_of_the_leaves_one_by_one():
    weight = np.random.default_rng(1).uniform(0.5, 2, 300)
    forest, X, _, groups, _ = grown(weight)
    asked = X[:10] * 0.9
    leaves = [tree.apply(asked.astype(np.float32)) for tree in forest.forest.estimators_]
    known = [tree.apply(X.astype(np.float32)) for tree in forest.forest.estimators_]
    expected = np.zeros((10, groups.max() + 1))
    for to, of, drawn in zip(leaves, known, forest.forest.estimators_samples_, strict=True):
        count = np.bincount(drawn, minlength=300) * weight
        for i, leaf in enumerate(to):
            share = np.bincount(groups, count * (of == leaf), minlength=expected.shape[1])
            expected[i] += share / share.sum() / len(known)
    np.testing.assert_allclose(forest.weights(forest.apply(asked))[0], expected, atol=1e-12)


def test_out_of_bag_rows_sum_to_one_and_follow_the_values():
    forest, _, y, groups, rows = grown(np.ones(300))
    (found,) = forest.out_of_bag_
    assert found.shape == (100, groups.max() + 1)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    assert np.corrcoef(forest.out_of_bag_mean_, y)[0, 1] > 0.9
    at = np.array([y[groups == g].mean() for g in range(found.shape[1])])
    np.testing.assert_allclose(found @ at, forest.out_of_bag_mean_[rows], atol=0.05)
