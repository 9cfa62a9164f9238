"""Several rates at once, bounds of the target, and sets of at most k intervals."""

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.stats import binom
from sklearn.ensemble import RandomForestClassifier

from conformodal.conformal import (
    ConformalRegressor,
    MaxIntervals,
    QuantileBins,
    check_coverage,
    conformal_quantile,
)
from conformodal.conformal.scores import shortest_sets

pytestmark = pytest.mark.filterwarnings("ignore:regions are unbounded")
RNG = np.random.default_rng(0)


def runs(mask):
    return np.count_nonzero(np.diff(np.pad(mask.astype(int), (1, 0))) == 1)


@pytest.mark.parametrize(("k", "mass"), [(k, mass) for k in (1, 2, 3) for mass in (0.3, 0.7, 0.9)])
def test_the_programme_finds_the_shortest_set(k, mass):
    masks = [mask for mask in np.array(list(product([False, True], repeat=8))) if runs(mask) <= k]
    proba, widths = RNG.multinomial(200, RNG.dirichlet(np.full(8, 0.5), 40)) / 200, RNG.uniform(0.1, 2, 8)
    for own, found in zip(proba, shortest_sets(proba, widths, mass, k), strict=True):
        best = min(widths[mask].sum() for mask in masks if own[mask].sum() > mass - 1e-9)
        assert runs(found) <= k
        assert own[found].sum() > mass - 1e-9
        assert widths[found].sum() == pytest.approx(best)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_sets_at_every_threshold_nest_and_have_few_intervals(k):
    proba, widths = RNG.dirichlet(np.full(15, 0.3), 60), RNG.uniform(0.01, 2, 15)
    proba[:20] = np.where(proba[:20] < 0.05, 0, proba[:20])
    proba /= proba.sum(axis=1, keepdims=True)
    scores = MaxIntervals(k, 0.2).of_bins(proba, widths)
    for row, own, anchor in zip(scores, proba, shortest_sets(proba, widths, 0.8, k), strict=True):
        assert max(runs(row <= level) for level in row) <= k
        assert any(((row <= level) & (own > 0) == anchor & (own > 0)).all() for level in row)  # a set of the family


def test_coverage_with_few_intervals_follows_the_exact_law():
    """Of 19 calibration samples at alpha = 0.1, the threshold covers a new one with probability 18/20."""
    proba, widths, splits = RNG.dirichlet(np.full(20, 0.3), 300), np.full(20, 1 / 20), 4000
    scores = MaxIntervals(2).of_bins(proba, widths)
    rows, codes = RNG.permuted(np.tile(np.arange(300), (splits, 1)), axis=1)[:, :20], RNG.integers(0, 20, (splits, 20))
    drawn = scores[rows, codes]
    covered = (drawn[:, 0] <= conformal_quantile(drawn[:, 1:], 0.1, axis=1)).sum()
    low, high = binom.interval(0.999, splits, 18 / 20)
    assert low <= covered <= high


def two_modes(n=1500):
    X = RNG.uniform(0, 1, (n, 1))
    return X, RNG.choice([1, 3], n) * (0.5 + X[:, 0]) * RNG.uniform(0.9, 1.1, n)


def fitted(n_train=800, **options):
    X, y = two_modes()
    forest = RandomForestClassifier(20, min_samples_leaf=10, random_state=0)
    options = {"n_bins": 30, "random_state": 0} | options
    return ConformalRegressor(forest, **options).fit(X[:n_train], y[:n_train]), X[n_train:], y[n_train:]


@pytest.mark.parametrize("options", [{}, {"max_intervals": 2}, {"conformity_score": "lac"}])
def test_several_rates_give_nested_regions(options):
    reg, X, y = fitted(**options)
    found = reg.predict_region(X, alpha=[0.05, 0.1, 0.3])
    for wide, tight in pairwise(found):
        assert (wide.masks[0] >= tight.masks[0]).all()
    np.testing.assert_array_equal(found[1].masks[0], reg.predict(X, region=True).masks[0])
    assert [len(regions) for regions in reg.predict(X, region=True, alpha=(0.2,))] == [len(y)]


@pytest.mark.parametrize("k", [1, 2])
def test_a_limit_on_the_intervals_keeps_coverage(k):
    reg, X, y = fitted(max_intervals=k)
    regions = reg.predict_region(X)
    assert regions.n_intervals.max() == k
    assert check_coverage(regions.contains(y)[:, 0], 160, 0.1, 0.999).inside


def test_no_set_reaches_beyond_the_bounds():
    reg, X, y = fitted(n_train=40, y_min=0, y_max=5, alpha=0.01, calibration_size=0.2)
    regions = reg.predict_region(X)
    assert regions.unbounded.all()
    assert (regions.length == 5).all()
    assert (regions.hull == [0, 5]).all()
    np.testing.assert_array_equal(regions.intervals(0)[0], [[0, 5]])
    np.testing.assert_array_equal(regions.flat_intervals()[1][:1], [[0, 5]])
    assert regions.contains(y).all()
    assert not regions.contains(np.full(len(y), 6.0)).any()


def test_bounds_cut_the_outer_bins():
    y = np.column_stack((np.abs(RNG.normal(size=200)), RNG.normal(size=200)))
    edges = QuantileBins(10, margin=0.5, tail=1.0, y_min=[0, -np.inf]).fit(y).edges_
    assert edges[0][0] == 0
    assert edges[1][0] < y[:, 1].min()
    assert edges[0][-1] > 2 * y[:, 0].max() - 1
