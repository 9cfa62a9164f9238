"""Joint regions as level sets of a joint density."""

import numpy as np
import pytest
from scipy.stats import binom
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import (
    ConformalError,
    ConformalRegressor,
    LevelSetConformal,
    NotCalibratedError,
    PredictiveDensity,
    QuantileBins,
    check_coverage,
    conformal_quantile,
    region_scorers,
)
from conformodal.conformal.level_sets import LevelSets, log_joint_density

RNG = np.random.default_rng(0)
BINS = QuantileBins.from_edges([[0, 1, 2, 4], [-1, 0, 3]])
PROBA = [RNG.dirichlet(np.ones(3), 300), RNG.dirichlet(np.ones(2), 300)]
CORRELATION = np.array([[1, 0.8], [0.8, 1]])


def grid(n=200):
    """Middles of n x n cells of the bins' range, and the area of a cell."""
    ends = [(e[0], e[-1]) for e in BINS.edges_]
    axes = [low + (np.arange(n) + 0.5) * (high - low) / n for low, high in ends]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), np.prod(np.diff(ends)) / n**2


def densities(i, y):
    rows = PredictiveDensity(BINS, [np.repeat(part[i : i + 1], len(y), axis=0) for part in PROBA])
    return log_joint_density(rows, CORRELATION, y)


@pytest.mark.parametrize("level", [-4.0, -1.5])
def test_the_density_is_one_and_volumes_are_those_of_the_sets(level):
    y, area = grid()
    sets = LevelSets(PredictiveDensity(BINS, [part[:4] for part in PROBA]), CORRELATION, level)
    found = np.exp(sets.log_volume(5000))
    for i in range(4):
        log = densities(i, y)
        assert np.exp(log).sum() * area == pytest.approx(1, abs=0.02)
        assert found[i] == pytest.approx((log >= level).sum() * area, rel=0.05, abs=0.06)


def test_coverage_follows_the_exact_law():
    """Of 19 calibration samples at alpha = 0.1, the level covers a new one with probability 18/20."""
    splits = 4000
    rows = RNG.permuted(np.tile(np.arange(300), (splits, 1)), axis=1)[:, :20].ravel()
    y = np.column_stack([RNG.uniform(0, 4, rows.size), RNG.uniform(-1, 3, rows.size)])
    density = PredictiveDensity(BINS, [part[rows] for part in PROBA])
    scores = -log_joint_density(density, CORRELATION, y).reshape(splits, 20)
    covered = (scores[:, 0] <= conformal_quantile(scores[:, 1:], 0.1, axis=1)).sum()
    low, high = binom.interval(0.999, splits, 18 / 20)
    assert low <= covered <= high
    calibrator = LevelSetConformal(BINS, 0.1)
    calibrator.correlation_ = CORRELATION
    sets = calibrator.calibrate([part[rows[1:20]] for part in PROBA], y[1:20]).predict([part[rows] for part in PROBA])
    np.testing.assert_array_equal(sets.contains(y), scores.ravel() <= np.sort(scores[0, 1:])[17])


def test_the_copula_learns_how_errors_depend():
    y = np.exp(RNG.multivariate_normal([0, 0], CORRELATION, 1000))
    bins = QuantileBins(30).fit(y)
    proba = [np.full((1000, 30), 1 / 30)] * 2
    correlation = LevelSetConformal(bins).fit_copula(proba, y).correlation_
    assert correlation[0, 1] == pytest.approx(0.8, abs=0.04)
    np.testing.assert_allclose(np.diag(correlation), 1)


def fitted(n=600, **options):
    X = RNG.uniform(-1, 1, (n + 1000, 1))
    shared, own = RNG.normal(size=(n + 1000, 1)), RNG.normal(size=(n + 1000, 2))
    y = X + 0.3 * shared + 0.05 * own
    options = {"joint": "density", "n_bins": 20, "random_state": 0} | options
    reg = ConformalRegressor(DecisionTreeClassifier(max_depth=3, random_state=0), **options).fit(X[:n], y[:n])
    return reg, X[n:], y[n:]


def test_a_regressor_gives_joint_regions_smaller_than_products():
    reg, X, y = fitted()
    wide, sets, tight = reg.predict_region(X, alpha=[0.05, 0.1, 0.3])
    assert check_coverage(sets.contains(y), 120, 0.1, 0.999).inside
    assert (wide.contains(y) >= sets.contains(y)).all()
    assert (sets.contains(y) >= tight.contains(y)).all()
    products = fitted(joint="max")[0].predict_region(X)
    assert sets.log_volume(200).mean() < np.log(products.volume).mean() - 0.5
    scorers = region_scorers()
    assert scorers["coverage"](reg, X, y) == sets.contains(y, joint=True).mean()
    neg_length = scorers["neg_length"]
    for refused in (lambda: neg_length(reg, X, y), lambda: reg.diagnose(X, y), lambda: sets.contains(y, joint=False)):
        with pytest.raises(ConformalError, match=r"LevelSet|level sets"):
            refused()


@pytest.mark.filterwarnings("ignore:regions are unbounded", "ignore:The number of unique")
def test_too_few_rows_bounds_and_what_does_not_fit():
    reg, X, y = fitted(30, y_min=-9, y_max=9)
    sets = reg.predict_region(X)
    np.testing.assert_allclose(sets.log_volume(), 2 * np.log(18))
    assert sets.contains(y).all()
    assert not sets.contains(y + 20).any()
    with pytest.raises(NotCalibratedError):
        LevelSetConformal(BINS).predict(PROBA)
    for options in ({"score": "lac"}, {"max_intervals": 1}):
        with pytest.raises(ConformalError, match="joint='density'"):
            fitted(**options)
    with pytest.raises(ConformalError, match="takes neither groups"):
        ConformalRegressor(joint="density").fit(X, y, groups=X[:, 0] > 0)
