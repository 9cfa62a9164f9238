import numpy as np
import pytest
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.tree import DecisionTreeClassifier
from sklearn.utils import check_random_state

from conformodal.conformal import ConformalRegressor, ConformodalError
from conformodal.conformal.bins import nearest_bins
from conformodal.conformal.density.learners import BinSmoothing, split_off

CLASSIFIERS = {
    "forest": RandomForestClassifier(30, random_state=0),
    "tree": DecisionTreeClassifier(random_state=0),
    "k-NN": KNeighborsClassifier(),
}


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_sparse_classifiers_give_near_shortest_sets(name):
    """These classifiers give most bins no probability."""
    rng = np.random.default_rng(0)
    X, y = rng.uniform(-1, 1, (2500, 3)), rng.standard_normal(2500)  # nothing can be learnt: 3.29 is the shortest
    reg = ConformalRegressor(CLASSIFIERS[name], random_state=0).fit(X[:1000], y[:1000])
    regions = reg.predict_region(X[1000:])
    assert regions.length.mean() < 1.3 * 3.29
    assert abs(regions.contains(y[1000:]).mean() - 0.9) < 0.07  # three standard deviations at 200 calibration rows


def test_smoothing_keeps_a_point_mass_at_zero():
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 1, (3000, 2))
    y = np.where(rng.random(3000) < X[:, 0], 0.0, rng.standard_normal(3000))
    reg = ConformalRegressor(CLASSIFIERS["k-NN"], n_bins=30, random_state=0).fit(X, y)
    zero = int(reg.bins_.encode([0.0])[0, 0])
    beside = [zero - 1, zero + 1]
    smoothing = reg.estimators_[0].smoothing
    proba = rng.dirichlet(np.ones(reg.bins_.sizes[0]), 5)
    for i in range(smoothing.weights.size - 1):
        smoothing.weights = np.eye(smoothing.weights.size)[i]
        np.testing.assert_allclose(smoothing(proba)[:, zero], proba[:, zero], atol=1e-12)
    reg.fit(X, y)
    found = reg.predict_bins(X)[0]
    assert abs(found[:, zero].mean() - 0.5) < 0.1
    assert found[:, beside].mean() < 0.05  # each holds about a thirtieth of what is not zero


def test_held_out_values_decide_how_much_to_smooth():
    rng = np.random.default_rng(0)
    n_bins, edges = 20, np.arange(21.0)
    truth = rng.dirichlet(np.full(n_bins, 0.3), 4000)
    codes = (truth.cumsum(axis=1) > rng.random((4000, 1))).argmax(axis=1)
    y = codes + 0.25 + rng.random(4000) / 2
    smoothing = BinSmoothing(y, edges, None)
    smoothing.tune(truth, y, edges, None)
    assert smoothing.weights[0] > 0.9  # right as they are
    smoothing.tune(rng.permutation(truth), y, edges, None)
    assert smoothing.weights[0] < 0.1
    assert (smoothing.weights > 0).all()


def test_strengths_do_not_depend_on_calibration_rows():
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (400, 1))
    y = X[:, 0] + 0.3 * rng.standard_normal(400)
    held, _ = split_off(400, 0.2, check_random_state(0))
    other = y.copy()
    other[held] = rng.permutation(y[held])
    reg = ConformalRegressor(CLASSIFIERS["k-NN"], random_state=0)
    first, second = (reg.fit(X, values).predict_bins(X)[0] for values in (y, other))
    np.testing.assert_array_equal(first, second)


class Rote:
    """A density that is certain of rows that it has seen, and ignorant of others."""

    def get_params(self, deep=True):
        return {}

    def fit_bins(self, X, y, edges):
        self.known = dict(zip(X[:, 0].tolist(), nearest_bins(y, edges).tolist(), strict=True))
        self.n_bins = edges.size - 1
        return self

    def predict_proba(self, X):
        found = np.full((len(X), self.n_bins), 1 / self.n_bins)
        for row, at in enumerate(X[:, 0].tolist()):
            if at in self.known:
                found[row] = np.arange(self.n_bins) == self.known[at]
        return found


@pytest.mark.parametrize("estimator", [Rote(), CLASSIFIERS["tree"]], ids=["density", "classifier"])
def test_joint_scales_use_held_out_rows(estimator):
    rng = np.random.default_rng(0)
    X, Y = rng.random((500, 1)), rng.random((500, 2))
    reg = ConformalRegressor(
        estimator, n_bins=10, conformity_score="lac", joint="max", calibration_size=0, random_state=0
    )
    # of rows that were learnt from the median score is 0: certainty
    assert (reg.fit(X, Y).calibrator_.loc_ > 0.5).all()


def test_weights_reach_a_classifier_and_who_takes_none_is_named():
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (200, 1))
    y = X[:, 0] + rng.standard_normal(200)
    weight = np.where(y > 0, 5.0, 1.0)
    reg = ConformalRegressor(LogisticRegression(), n_bins=5, random_state=0)
    plain, heavy = reg.fit(X, y).predict(X), reg.fit(X, y, weight).predict(X)
    assert heavy.mean() > plain.mean() + 0.2
    for estimator in (KNeighborsClassifier(), "stack"):
        with pytest.raises(ConformodalError, match=r"cannot be fitted: .*sample_weight"):
            ConformalRegressor(estimator, n_bins=5).fit(X, y, weight)
