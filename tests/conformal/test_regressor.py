import numpy as np
import pytest
from sklearn.base import clone
from sklearn.ensemble import RandomForestClassifier
from sklearn.tree import DecisionTreeClassifier
from sklearn.utils.estimator_checks import check_estimator, parametrize_with_checks

from conformodal.conformal import ConformalRegressor, NotCalibratedError
from conformodal.conformal.density import named
from conformodal.conformal.density.named import boosting


def forest():
    return RandomForestClassifier(20, min_samples_leaf=5, random_state=0)


# the split holds out some repetitions of a row and learns from others, which no weight of the row can do
NOT_OF_SPLITS = dict.fromkeys(
    ("check_sample_weight_equivalence_on_dense_data", "check_sample_weight_equivalence_on_sparse_data"),
    "repeated rows are split, weighted rows are not",
)


@pytest.mark.filterwarnings("ignore")
@parametrize_with_checks(
    [ConformalRegressor(DecisionTreeClassifier(min_samples_leaf=5, random_state=0), n_bins=10, random_state=0)],
    expected_failed_checks=lambda _: NOT_OF_SPLITS,
)
def test_it_is_a_scikit_learn_estimator(estimator, check):
    check(estimator)


def bimodal(n, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 1))
    return X, rng.choice([-1, 1], n) * (1.5 + X[:, 0]) + rng.normal(0, 0.1, n)


def test_two_modes():
    X, y = bimodal(2000)
    reg = ConformalRegressor(forest(), n_bins=30, conformity_score="lac", random_state=0)
    assert clone(reg).get_params()["conformity_score"] == "lac"
    reg.fit(X[:1500], y[:1500])
    regions = reg.predict_region(X[1500:])
    assert abs(regions.contains(y[1500:]).mean() - 0.9) < 0.05
    assert np.median(regions.n_intervals) == 2
    wide = reg.predict_region(X[1500:], alpha=0.02)
    assert (wide.length >= regions.length).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_default_passes_the_checks_of_scikit_learn(monkeypatch):
    # hundreds of fits: short ones
    monkeypatch.setattr(named, "boosting", lambda rate, rounds, *rest: boosting(rate, 3, *rest))
    monkeypatch.setattr(named, "_TREES_AND_FOLDS", ((np.inf, 5, 5),))
    default = ConformalRegressor(n_bins=10, random_state=0)
    check_estimator(default, on_skip=None, expected_failed_checks=NOT_OF_SPLITS)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["quick", "stack"])
def test_a_named_density_on_two_targets(estimator):
    X, y = bimodal(500)
    Y = np.column_stack((y, X[:, 0] * 2 + np.random.default_rng(1).normal(0, 0.1, 500)))
    reg = ConformalRegressor(estimator, random_state=0, calibration_size=0).fit(X[:250], Y[:250])
    with pytest.raises(NotCalibratedError, match="conformalize"):
        reg.predict_region(X)
    regions = reg.conformalize(X[250:400], Y[250:400]).predict_region(X[400:])
    assert (regions.contains(Y[400:]).mean(axis=0) > 0.8).all()
    assert np.abs(regions.n_intervals.mean(axis=0) - [2, 1]).max() < 0.5
    assert reg.predict(X).shape == (500, 2)


def test_weights_of_zero_leave_samples_out_of_all():
    X, y = bimodal(400)
    weight = np.where(X[:, 0] > 0.5, 0.0, 2.0)
    reg = ConformalRegressor(forest(), n_bins=10, random_state=0)
    weighted = reg.fit(X, y, weight).predict_bins(X)
    thresholds = reg.calibrator_.thresholds_
    plain = reg.fit(X[weight > 0], y[weight > 0], np.ones((weight > 0).sum())).predict_bins(X)
    np.testing.assert_array_equal(weighted, plain)
    np.testing.assert_array_equal(thresholds, reg.calibrator_.thresholds_)
