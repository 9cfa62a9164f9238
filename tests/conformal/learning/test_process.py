import numpy as np
import pytest
from scipy.optimize import check_grad
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Matern

from conformodal.conformal.learning import process
from conformodal.conformal.learning.location import folds_of
from conformodal.conformal.learning.process import SparseProcess


def table(n, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 3))
    return X, np.sin(3 * X[:, 0]) + X[:, 1] ** 2 + 0.1 * rng.standard_normal(n)


@pytest.mark.parametrize("lengths", [1, 3])
def test_the_gradient_is_that_of_the_likelihood(lengths):
    X, y = table(40)
    weight = np.random.default_rng(1).uniform(0.5, 2, 40)
    at = np.append(np.linspace(-0.5, 0.5, lengths), (0.3, -2.0))
    args = (X, y, weight, 0.7)
    apart = check_grad(lambda t: process._unlikelihood(t, *args)[0], lambda t: process._unlikelihood(t, *args)[1], at)
    assert apart < 1e-4 * np.linalg.norm(process._unlikelihood(at, *args)[1])


def test_predictions_in_and_out_of_fold_are_those_of_scikit_learn():
    X, y = table(80)
    folds = folds_of(80, 0)
    found = SparseProcess(0).fit(X, y, np.ones(80), folds)
    features = found._features(X) * found._inverse
    oracle = GaussianProcessRegressor(Matern(1.0, "fixed", nu=1.5), alpha=found._noise + 1e-8, optimizer=None)
    other = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    oracle.fit(features, y - y.mean())
    expected = oracle.predict(found._features(other) * found._inverse) + y.mean()
    np.testing.assert_allclose(found.predict(other), expected, atol=1e-8)
    seen, left_out = folds[0]
    expected = oracle.fit(features[seen], y[seen] - y.mean()).predict(features[left_out]) + y.mean()
    np.testing.assert_allclose(found.out_of_fold_[left_out], expected, atol=1e-8)


def repeated_and_weighted(model_of):
    """Predictions of one process on repeated rows and on weighted ones, at the same scales and points."""
    X, y = table(60)
    times = np.random.default_rng(3).integers(1, 4, 60)
    rows = np.repeat(np.arange(60), times)
    folds = [(np.flatnonzero(np.arange(60) % 2), np.flatnonzero(np.arange(60) % 2 == 0))]
    long = [(np.flatnonzero(np.isin(rows, a)), np.flatnonzero(np.isin(rows, b))) for a, b in folds]
    folds, long = [*folds, folds[0][::-1]], [*long, long[0][::-1]]
    light, heavy = model_of(X), model_of(X)
    one = getattr(light, light.how)(X, y, times.astype(float), folds)
    other = getattr(heavy, heavy.how)(X[rows], y[rows], np.ones(rows.size), long)
    return one[rows], other, light, heavy


@pytest.mark.parametrize("how", ["_solve_exact", "_solve_sparse"])
def test_a_whole_number_weight_is_worth_as_many_repetitions(how):
    def model_of(X):
        model = SparseProcess(0)
        model._noise, model._points, model.how = 0.05, X[:30], how
        return model

    one, other, light, heavy = repeated_and_weighted(model_of)
    np.testing.assert_allclose(one, other, atol=1e-5)
    if how == "_solve_sparse":
        np.testing.assert_allclose(light._slopes, heavy._slopes, rtol=1e-4, atol=1e-4)


def test_many_rows_are_answered_from_few(monkeypatch):
    monkeypatch.setattr(process, "_EXACT_ROWS", 100)
    monkeypatch.setattr(process, "_INDUCING", 80)
    X, y = table(400)
    found = SparseProcess(0).fit(X, y, np.ones(400), folds_of(400, 0))
    truth = np.sin(3 * X[:, 0]) + X[:, 1] ** 2
    assert found._points.shape == (80, 3)
    assert np.sqrt(np.mean((found.predict(X) - truth) ** 2)) < 0.08
    assert np.sqrt(np.mean((found.out_of_fold_ - truth) ** 2)) < 0.1


def test_many_features_share_a_length():
    rng = np.random.default_rng(0)
    X = rng.standard_normal((60, 45))
    found = SparseProcess(0).fit(X, X[:, 0], np.ones(60), folds_of(60, 0))
    assert np.ptp(found._inverse) == 0
