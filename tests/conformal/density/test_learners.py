import warnings

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.neighbors import KNeighborsClassifier

from conformodal.conformal import ConformalRegressor, ConformodalError, QuickDensity, SlowFitWarning, StackedDensity
from conformodal.conformal.density.fitting import warn_if_slow


class Slow:
    """A density that says it takes a minute, and learns the marginal distribution."""

    def __init__(self, seconds=60.0):
        self.seconds = seconds

    def get_params(self, deep=True):
        return {"seconds": self.seconds}

    def set_params(self, **params):
        self.__dict__ |= params
        return self

    def expected_seconds(self, n_rows, n_features):
        return self.seconds

    def fit_bins(self, X, y, edges):
        self.mass = np.histogram(y, edges)[0] / len(y)
        return self

    def predict_proba(self, X):
        return np.tile(self.mass, (len(X), 1))


def table(n=60):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (n, 1))
    return X, X[:, 0] + rng.standard_normal(n)


def test_a_slow_fit_is_a_warning():
    with pytest.warns(SlowFitWarning, match=r"48 rows will take about 60 seconds") as warned:
        ConformalRegressor(Slow(), n_bins=5, random_state=0).fit(*table())
    assert warned[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ConformalRegressor(Slow(9.0), n_bins=5, random_state=0).fit(*table())


def test_expected_seconds_grow_with_the_table():
    with pytest.warns(SlowFitWarning, match='estimator="quick"'):
        warn_if_slow(StackedDensity(), 300, 10, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_slow(QuickDensity(), 20_000, 10, 1)
        warn_if_slow(GaussianNB(), 10**9, 10, 1)
    with pytest.warns(SlowFitWarning, match="minutes"):
        warn_if_slow(QuickDensity(), 30_000, 2000, 1)


def test_weights_reach_a_classifier():
    X, y = table(200)
    weight = np.where(y > 0, 5.0, 1.0)
    reg = ConformalRegressor(LogisticRegression(), n_bins=5, random_state=0)
    plain, heavy = reg.fit(X, y).predict(X), reg.fit(X, y, weight).predict(X)
    assert heavy.mean() > plain.mean() + 0.2


@pytest.mark.filterwarnings("ignore::conformodal.conformal.SlowFitWarning")
def test_who_takes_no_weights_is_named():
    X, y = table()
    for estimator, name in ((KNeighborsClassifier(), "KNeighbors"), ("stack", "StackedDensity")):
        with pytest.raises(
            ConformodalError, match=f"sample_weight needs an estimator whose fit.* takes it, got {name}"
        ):
            ConformalRegressor(estimator, n_bins=5).fit(X, y, np.ones(60))
