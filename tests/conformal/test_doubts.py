"""Rows whose coverage is not that of new rows are told; sound tables are not."""

import numpy as np
import pandas as pd
import pytest
from sklearn.datasets import load_diabetes, make_friedman1
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import ConformalRegressor, DataWarning
from conformodal.conformal.doubts import doubt_rows

RNG = np.random.default_rng(0)
N = 1200


def subjects(n_units=30):
    rng = np.random.default_rng(1)
    unit, x = np.arange(N) % n_units, rng.normal(size=N)
    y = x + rng.normal(0, 3, n_units)[unit] + rng.normal(0, 0.5, N)
    return pd.DataFrame({"subject": unit, "x": x}), y


def walk(dated):
    table = pd.DataFrame({"temp": RNG.normal(size=N)})
    if dated:
        table["day"] = pd.date_range("2018-01-01", periods=N)
    return table, np.cumsum(np.random.default_rng(3).normal(size=N))


def change():
    days = pd.date_range("2018-01-01", periods=N)
    level = 2.5 * (np.arange(N) > 0.85 * N) + np.random.default_rng(4).normal(size=N)
    return pd.DataFrame({"day": days, "temp": RNG.normal(size=N)}), level


def repeated(noise):
    at = np.arange(N) % 300
    table = pd.DataFrame(np.random.default_rng(2).normal(size=(300, 3)), columns=list("abc"))
    y = table.a + RNG.normal(size=300)
    return table.iloc[at].reset_index(drop=True), y.to_numpy()[at] + RNG.normal(0, noise, N)


def numbered(table, y):
    return table.assign(order=RNG.permutation(10 * N)[:N]), y


@pytest.mark.parametrize(
    ("table", "named"),
    [
        (subjects(), "new subject"),
        (walk(True), "in time are alike"),
        (walk(False), "in order are alike"),
        (change(), "the target depends on the date"),
        (repeated(0), "1200 of 1200 rows are identical"),
        (numbered(*repeated(0)), "1200 of 1200 rows are identical"),
        (repeated(0.1), "new set of inputs"),
    ],
)
@pytest.mark.parametrize("shuffled", [False, True])
def test_rows_that_are_not_exchangeable_are_told(table, named, shuffled):
    X, y = table
    at = RNG.permutation(N) if shuffled else np.arange(N)  # the index keeps the order
    words = doubt_rows(X.iloc[at], y[at, None], False, False)
    assert named in " ".join(words)
    assert not doubt_rows(X.iloc[at], y[at, None], True, True)


def sound_tables():
    labels = pd.DataFrame({name: RNG.choice(list("abcde"), N) for name in "uvw"})
    X, y = make_friedman1(N, random_state=0)
    up, x = np.argsort(y), np.linspace(0, 1, N)
    return [
        load_diabetes(return_X_y=True, as_frame=True), (labels, (labels.u == "a") + RNG.integers(0, 5, N)), (X, y),
        (X[up], y[up]), (x[:, None], np.sin(9 * x) + RNG.normal(0, 0.1, N)), (X[:30], y[:30]),
        numbered(pd.DataFrame(X), y),
    ]  # fmt: skip


@pytest.mark.parametrize("table", sound_tables(), ids=["diabetes", "labels", "friedman", "sorted", "grid", "few", "id"])
def test_sound_tables_are_not_told(table):
    assert doubt_rows(table[0], np.asarray(table[1], float)[:, None], False, False) == []


def test_units_and_the_last_rows_mend_what_is_told():
    tree = DecisionTreeClassifier(min_samples_leaf=5, random_state=0)
    X, y = subjects(60)
    reg = ConformalRegressor(tree, n_bins=20, random_state=0)
    new = X.subject.to_numpy() >= 45
    with pytest.warns(DataWarning, match="of a new subject"):
        usual = reg.fit(X[~new], y[~new])
    assert usual.predict_region(X[new]).contains(y[new]).mean() < 0.7
    mended = reg.fit(X.loc[~new, ["x"]], y[~new], units=X.subject[~new])
    assert mended.calibrator_.n_units == 10
    assert mended.predict_region(X.loc[new, ["x"]]).contains(y[new]).mean() > 0.8
    X, y = walk(True)
    last = ConformalRegressor(tree, n_bins=20, random_state=0, calibration="last", calibration_size=0.25)
    assert last.fit(X[["temp"]], y).calibrator_.n_units == 300


def test_bins_reach_far_beyond_the_values_where_units_are_few():
    X, y = subjects(40)
    tree = DecisionTreeClassifier(min_samples_leaf=5, random_state=0)
    reg = ConformalRegressor(tree, n_bins=20, random_state=0).fit(X[["x"]], y, units=X.subject)
    assert reg.calibrator_.n_units == 10
    assert np.ptp(reg.bins_.edges_[0]) > 2 * np.ptp(y)  # else one value beyond would unbound all sets


def test_a_coverage_given_for_alpha_is_asked_about():
    X, y = make_friedman1(100, random_state=0)
    tree = DecisionTreeClassifier(min_samples_leaf=5, random_state=0)
    with pytest.warns(DataWarning, match=r"alpha = 0\.95 .*did you mean 0\.05, for 95%"):
        ConformalRegressor(tree, n_bins=8, alpha=0.95).fit(X, y)
