"""Several rates at once, and bounds of the target."""

from itertools import pairwise

import numpy as np
import pytest
from sklearn.ensemble import RandomForestClassifier

from conformodal.conformal import ConformalRegressor, QuantileBins

pytestmark = pytest.mark.filterwarnings("ignore:regions are unbounded")
RNG = np.random.default_rng(0)


def two_modes(n=1500):
    X = RNG.uniform(0, 1, (n, 1))
    return X, RNG.choice([1, 3], n) * (0.5 + X[:, 0]) * RNG.uniform(0.9, 1.1, n)


def fitted(n_train=800, **options):
    X, y = two_modes()
    forest = RandomForestClassifier(20, min_samples_leaf=10, random_state=0)
    options = {"n_bins": 30, "random_state": 0} | options
    return ConformalRegressor(forest, **options).fit(X[:n_train], y[:n_train]), X[n_train:], y[n_train:]


@pytest.mark.parametrize("options", [{}, {"conformity_score": "lac"}])
def test_several_rates_give_nested_regions(options):
    reg, X, y = fitted(**options)
    found = reg.predict_region(X, alpha=[0.05, 0.1, 0.3])
    for wide, tight in pairwise(found):
        assert (wide.masks[0] >= tight.masks[0]).all()
    np.testing.assert_array_equal(found[1].masks[0], reg.predict(X, region=True).masks[0])
    assert [len(regions) for regions in reg.predict(X, region=True, alpha=(0.2,))] == [len(y)]


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
