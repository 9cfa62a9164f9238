"""Distributions of other models as probabilities of bins, and regressors that predict them."""

import numpy as np
import pytest
from scipy.stats import norm
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator

from conformodal.conformal import ConformalRegressor, QuantileBins

BINS = QuantileBins.from_edges([np.linspace(-6, 6, 41)])
MEAN, SIGMA = np.array([-1.0, 0.0, 2.5]), np.array([0.5, 1.0, 1.5])
BELOW = norm.cdf(BINS.edges_[0][1:-1], MEAN[:, None], SIGMA[:, None])
EXACT = np.diff(np.pad(BELOW, ((0, 0), (1, 1)), constant_values=((0, 0), (0, 1))), axis=1)


def test_a_distribution_function_is_exact_and_outer_bins_get_the_rest():
    bins = QuantileBins.from_edges([[-1.0, 0.0, 1.0]])
    proba = bins.proba_from_cdf(norm(MEAN, SIGMA).cdf)
    np.testing.assert_allclose(proba[:, 0], norm.cdf(0, MEAN, SIGMA))
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    np.testing.assert_allclose(BINS.proba_from_cdf(norm(MEAN, SIGMA).cdf), EXACT, atol=1e-12)


@pytest.mark.parametrize("n_levels", [9, 99])
def test_quantiles_are_interpolated_and_no_bin_has_probability_zero(n_levels):
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
