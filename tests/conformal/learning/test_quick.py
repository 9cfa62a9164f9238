import numpy as np
import pytest
from scipy.stats import norm
from sklearn.exceptions import NotFittedError

from conformodal.conformal import ConformalError, ConformalRegressor, QuickDensity, check_coverage

EDGES = np.linspace(-3, 3, 61)


def two_branches(n, seed):
    """Two branches of equal probability and known spread: the density is known."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 2))
    return X, rng.choice([-1, 1], n) * (1 + 0.5 * X[:, 0]) + 0.2 * rng.standard_normal(n)


def true_masses(X, edges):
    below = sum(norm.cdf((edges - side * (1 + 0.5 * X[:, :1])) / 0.2) for side in (-1, 1)) / 2
    below[:, 0], below[:, -1] = 0, 1
    return np.diff(below, axis=1)


@pytest.fixture(scope="module")
def fitted():
    return QuickDensity(random_state=0).fit_bins(*two_branches(1000, 0), EDGES)


def test_it_finds_a_known_density_of_two_modes(fitted):
    X, _ = two_branches(500, 1)
    found, truth = fitted.predict_proba(X), true_masses(X, EDGES)
    apart = 0.5 * np.abs(found - truth).sum(axis=1).mean()
    marginal = 0.5 * np.abs(truth.mean(axis=0) - truth).sum(axis=1).mean()
    assert apart < 0.2 < marginal
    middle = np.abs((EDGES[1:] + EDGES[:-1]) / 2) < 0.2
    assert found[:, middle].sum(axis=1).mean() < 0.05


def test_it_integrates_to_one_wherever_it_is_asked(fitted):
    X, _ = two_branches(300, 2)
    for asked in (X, 1e6 * X, X[:1], X[:0]):
        found = fitted.predict_proba(asked)
        assert found.shape == (len(asked), 60)
        assert (found > 0).any(axis=1).all()
        assert (found >= 0).all()
        np.testing.assert_allclose(found.sum(axis=1), 1)


def test_a_location_beside_the_truth_is_followed():
    rng = np.random.default_rng(3)
    X = rng.uniform(-1, 1, (600, 3))
    y = np.sin(3 * X[:, 0]) + X[:, 1] + 0.05 * rng.standard_normal(600)
    proba = QuickDensity(random_state=0).fit_bins(X[:500], y[:500], EDGES).predict_proba(X[500:])
    mean = proba @ ((EDGES[1:] + EDGES[:-1]) / 2)
    truth = np.sin(3 * X[500:, 0]) + X[500:, 1]
    assert np.sqrt(np.mean((mean - truth) ** 2)) < 0.1


def test_coverage_of_the_default_lies_in_its_exact_band():
    X, y = two_branches(1400, 4)
    reg = (
        ConformalRegressor(random_state=0, calibration_size=0)
        .fit(X[:500], y[:500])
        .conformalize(X[500:800], y[500:800])
    )
    inside = reg.predict_region(X[800:]).contains(y[800:])[:, 0]
    assert check_coverage(inside, 300, 0.1, 0.999).inside


def test_weights_of_zero_leave_rows_out_and_a_common_factor_means_nothing():
    X, y = two_branches(120, 5)
    weight = np.random.default_rng(0).integers(0, 3, 120).astype(float)
    kept = weight > 0
    one = QuickDensity(random_state=0).fit_bins(X, y, EDGES, weight).predict_proba(X)
    other = QuickDensity(random_state=0).fit_bins(X[kept], y[kept], EDGES, 7 * weight[kept]).predict_proba(X)
    np.testing.assert_allclose(one, other, atol=1e-9)
    plain = QuickDensity(random_state=0).fit_bins(X, y, EDGES).predict_proba(X)
    same = QuickDensity(random_state=0).fit_bins(X, y, EDGES, np.full(120, 3.0)).predict_proba(X)
    np.testing.assert_array_equal(plain, same)


def test_weights_move_the_density():
    X, y = two_branches(400, 6)
    upper = QuickDensity(random_state=0).fit_bins(X, y, EDGES, np.where(y > 0, 9.0, 1.0)).predict_proba(X)
    assert abs(upper[:, EDGES[1:] > 0].sum(axis=1).mean() - 0.9) < 0.04


@pytest.mark.parametrize("n", [2, 3, 7])
def test_few_rows_and_constant_columns(n):
    X, y = np.ones((n, 1)), np.arange(n, dtype=float)
    for values in (y, 0 * y):
        proba = QuickDensity(random_state=0).fit_bins(X, values, EDGES).predict_proba(X)
        np.testing.assert_allclose(proba.sum(axis=1), 1)


def test_rows_beyond_the_most_are_drawn_from():
    X, y = two_branches(300, 7)
    model = QuickDensity(max_rows=50, random_state=0).fit_bins(X, y, EDGES)
    assert model.location_.out_of_fold_.shape[0] == 50


def test_errors():
    X, y = two_branches(20, 0)
    with pytest.raises(NotFittedError):
        QuickDensity().predict_proba(X)
    for weight, what in (
        (np.ones(3), "shape"),
        (-np.ones(20), "Negative"),
        (np.full(20, np.nan), "NaN"),
        (np.zeros(20), "zero"),
        (np.eye(20)[0], "at least 2 rows"),
    ):
        with pytest.raises(ConformalError, match=what):
            QuickDensity().fit_bins(X, y, EDGES, weight)
    with pytest.raises(ConformalError, match="max_rows"):
        QuickDensity(max_rows=1).fit_bins(X, y, EDGES)
    with pytest.raises(ConformalError, match="one value per row"):
        QuickDensity().fit_bins(X, y[:3], EDGES)
