"""Distributions of other models as probabilities of bins, and regressors that predict them."""

import re
import warnings

import numpy as np
import pytest
from scipy.stats import laplace, norm
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator

from conformodal.conformal import ConformalRegressor, QuantileBins, SplitConformal

BINS = QuantileBins.from_edges([np.linspace(-6, 6, 41)])
MEAN, SIGMA = np.array([-1.0, 0.0, 2.5]), np.array([0.5, 1.0, 1.5])
BELOW = norm.cdf(BINS.edges_[0][1:-1], MEAN[:, None], SIGMA[:, None])
EXACT = np.diff(np.pad(BELOW, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=1)


def test_cdf_gives_exact_bin_probabilities():
    """The outer bins get what lies beyond them."""
    bins = QuantileBins.from_edges([[-1.0, 0.0, 1.0]])
    proba = bins.proba_from_cdf(norm(MEAN, SIGMA).cdf)
    np.testing.assert_allclose(proba[:, 0], norm.cdf(0, MEAN, SIGMA))
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    np.testing.assert_allclose(BINS.proba_from_cdf(norm(MEAN, SIGMA).cdf), EXACT, atol=1e-12)


@pytest.mark.parametrize("n_levels", [9, 99])
def test_quantiles_are_interpolated_to_bins(n_levels):
    """No bin gets probability zero."""
    levels = np.linspace(0, 1, n_levels + 2)[1:-1]
    values = norm.ppf(levels, MEAN[:, None], SIGMA[:, None])
    proba = BINS.proba_from_quantiles(levels, values[:, ::-1])  # quantiles that cross are sorted
    assert np.abs(np.cumsum(proba - EXACT, axis=1)).max() < 0.5 / n_levels
    assert (np.diff(proba[:, :10].cumsum(axis=1)) > 0).all()
    far = QuantileBins.from_edges([np.linspace(-20, 20, 81)]).proba_from_quantiles(levels, values)
    assert (far[1, :20][1:] > far[1, :20][:-1]).all()
    assert (proba >= 0).all()
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    constant = BINS.proba_from_quantiles(levels, np.full((1, n_levels), 0.1))
    assert constant.argmax() == np.searchsorted(BINS.edges_[0], 0.1) - 1


WIDE = QuantileBins.from_edges([np.linspace(-100, 100, 401)])
LEVELS = np.array([0.25, 0.75])


def test_the_upper_tail_is_as_exact_as_the_lower_one():
    # beyond the quartiles at -1 and 1 a quarter falls off by a factor e per unit
    proba = WIDE.proba_from_quantiles(LEVELS, [[-1.0, 1.0]])[0]
    end = WIDE.edges_[0]
    exact = 0.25 * np.exp(1 - end[202:-2]) * -np.expm1(-0.5)
    np.testing.assert_allclose(proba[202:-1], exact, rtol=1e-12)
    np.testing.assert_allclose(proba, proba[::-1], rtol=1e-12)


NARROW = {
    "quantiles": lambda x: WIDE.proba_from_quantiles(LEVELS, x[:, None] + [-0.1, 0.1]),
    "draws": lambda x: WIDE.proba_from_samples(x[:, None] + np.linspace(-0.5, 0.5, 20)),
    "functions": lambda x: WIDE.proba_from_cdf(laplace(x, 0.1).cdf, sf=laplace(x, 0.1).sf),
}


@pytest.mark.parametrize("given", NARROW)
def test_mirrored_values_give_mirrored_sets(given):
    """Of distributions that are too narrow for the errors."""
    rng = np.random.default_rng(0)
    x, error = rng.uniform(-30, 30, 1200), rng.exponential(8, 1200)
    lengths = []
    for sign in (1, -1):
        proba, y = NARROW[given](sign * x), sign * (x + error)
        cal = SplitConformal(WIDE, score="density").calibrate(proba[:600], y[:600])
        regions = cal.predict(proba[600:])
        assert abs(regions.contains(y[600:]).mean() - 0.9) < 0.03
        lengths.append(regions.length.mean())
    assert lengths[0] == pytest.approx(lengths[1], rel=0.02)
    assert lengths[0] < 45  # 2 * 8 * log(10) is 37


TIED = {
    "all as likely": (np.full((400, 4), 0.25), "density", False),
    "a tenth impossible": (np.eye(4)[np.r_[np.zeros(360, int), np.ones(40, int)]], "density", False),
    "more impossible": (np.eye(4)[np.r_[np.zeros(359, int), np.ones(41, int)]], "density", True),
    "impossible, by lac": (np.eye(4)[np.r_[np.zeros(359, int), np.ones(41, int)]], "lac", True),
    "lost in a sum": (np.array([[0, 1, 1e-30, 0]] * 400), "hpd", True),
    "separated by density": (np.array([[1e-30, 1, 0, 0]] * 400), "density", False),
    "too few to bound a set": (np.eye(4)[np.ones(5, int)], "density", False),
}


@pytest.mark.parametrize("case", TIED)
def test_zero_probability_values_warn(case):
    """Only where they make the sets whole ranges."""
    proba, score, told = TIED[case]
    bins = QuantileBins.from_edges([[0.0, 1.0, 2.0, 3.0, 4.0]])
    with warnings.catch_warnings(record=True) as words:
        warnings.simplefilter("always")
        cal = SplitConformal(bins, 0.1, score).calibrate(proba, np.full(len(proba), 0.5))
    assert bool(words) == told
    if told:
        assert cal.predict(np.eye(4)[:2]).masks[0].all()
        assert re.search(rf"sets are whole ranges: \d+ of {len(proba)} calibration values", str(words[0].message))


@pytest.mark.parametrize(("n_draws", "told"), [(1, True), (3, True), (4, False)])
def test_few_draws_warn(n_draws, told):
    with warnings.catch_warnings(record=True) as words:
        warnings.simplefilter("always")
        BINS.proba_from_samples(np.zeros((3, n_draws)))
    assert [f"{n_draws} draw" in str(one.message) for one in words] == [True] * told


def test_draws_are_smoothed():
    draws = np.random.default_rng(0).normal(MEAN[:, None], SIGMA[:, None], (3, 1000))
    proba = BINS.proba_from_samples(draws)
    assert np.abs(np.cumsum(proba - EXACT, axis=1)).max() < 0.06
    assert np.abs(proba - EXACT).sum(axis=1).max() < 0.2


class Line(BaseEstimator):
    """Normal distributions around a line."""

    def fit(self, X, y):
        self.slope_ = float(X[:, 0] @ y / (X[:, 0] @ X[:, 0]))
        self.sigma_ = float(np.std(y - self.slope_ * X[:, 0]))
        return self

    def normal(self, X):
        return norm(self.slope_ * X[:, 0], self.sigma_)

    def at(self, X, levels):
        return self.normal(X).ppf(np.array(levels)[:, None]).T


METHODS = {
    "NGBoost": ("pred_dist", lambda self, X: self.normal(X)),
    "quantiles": ("predict_quantiles", lambda self, X, levels: self.at(X, levels)),
    "quantile-forest": ("predict", lambda self, X, quantiles=None: self.at(X, quantiles)),
    "TabICL": ("predict", lambda self, X, output_type="", alphas=(): output_type == "quantiles" and self.at(X, alphas)),
}


@pytest.mark.parametrize("like", METHODS)
@pytest.mark.parametrize("frozen", [False, True])
def test_a_regressor_that_predicts_distributions_is_calibrated(like, frozen):
    kind = type("Model", (Line,), dict([METHODS[like]]))
    rng = np.random.default_rng(0)
    X = rng.uniform(-2, 2, (3000, 1))
    y = 2 * X[:, 0] + rng.normal(0, 0.5, 3000)
    model = FrozenEstimator(kind().fit(X[:500], y[:500])) if frozen else kind()
    reg = ConformalRegressor(model, random_state=0).fit(X[500:1500], y[500:1500])
    regions = reg.predict_region(X[1500:])
    assert abs(regions.contains(y[1500:]).mean() - 0.9) < 0.05
    assert regions.length.mean() == pytest.approx(2 * 1.645 * 0.5, rel=0.15)
    assert not hasattr(model, "slope_") or frozen  # clones are fitted
