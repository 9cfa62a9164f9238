"""Warnings of tables whose coverage is not that of new rows, and none of sound tables."""

import warnings
from itertools import permutations

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, norm
from sklearn.datasets import load_diabetes, make_friedman1
from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import BayesianRidge
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import ConformalRegressor, DataWarning
from conformodal.conformal.doubts import TableMemory, _chance, _chance_of_labels, doubt_rows

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
def test_non_exchangeable_rows_warn(table, named, shuffled):
    X, y = table
    at = RNG.permutation(N) if shuffled else np.arange(N)  # the index keeps the order
    words = doubt_rows(X.iloc[at], y[at, None], False, False)
    assert named in " ".join(words)
    assert not doubt_rows(X.iloc[at], y[at, None], True, True)


def by_input(kind):
    """A table that is sorted by an input."""
    rng = np.random.default_rng(5)
    X = pd.DataFrame(rng.normal(size=(N, 4)), columns=list("abcd"))
    y = (X.a + np.sin(2 * X.b) + 0.7 * rng.normal(size=N)).to_numpy()
    if kind == "rounded":
        X["a"] = X.a.round(1)
    if kind == "label":
        X["a"] = np.where(X.a > 0.5, "high", np.where(X.a < -0.5, "low", "mean"))
    order = X.a.argsort(kind="stable")[:: -1 if kind == "falling" else 1]
    X, y = X.iloc[order].reset_index(drop=True), y[order]
    return (X.set_index("a") if kind == "index" else X), y


def sound_tables():
    labels = pd.DataFrame({name: RNG.choice(list("abcde"), N) for name in "uvw"})
    X, y = make_friedman1(N, random_state=0)
    up, x = np.argsort(y), np.linspace(0, 1, N)
    return {
        "diabetes": load_diabetes(return_X_y=True, as_frame=True),
        "labels": (labels, (labels.u == "a") + RNG.integers(0, 5, N)),
        "friedman": (X, y),
        "sorted by the target": (X[up], y[up]),
        "grid": (x[:, None], np.sin(9 * x) + RNG.normal(0, 0.1, N)),
        "few": (X[:30], y[:30]),
        "id": numbered(pd.DataFrame(X), y),
        **{f"sorted by input, {kind}": by_input(kind) for kind in ("rising", "falling", "rounded", "label", "index")},
    }


SOUND = sound_tables()


@pytest.mark.parametrize("table", SOUND.values(), ids=SOUND)
def test_sound_tables_do_not_warn(table):
    X, y = table
    assert doubt_rows(X, np.asarray(y, float)[:, None], False, False) == []


@pytest.mark.parametrize("clock", [np.arange(N), 0.25 * np.arange(N)[::-1]])
def test_an_evenly_spaced_column_counts_as_time(clock):
    X, y = walk(False)
    assert "in order are alike" in " ".join(doubt_rows(X.assign(clock=clock), y[:, None], False, False))


def rounded(n_inputs, seed):
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 3, (N, n_inputs)).round(1 if n_inputs == 1 else 0)
    return pd.DataFrame(x), (x.sum(axis=1) + rng.normal(0, 0.4, N)).round(1 if n_inputs == 1 else 0)


@pytest.mark.parametrize("n_inputs", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_rounded_rows_are_not_called_copies(n_inputs, seed):
    X, y = rounded(n_inputs, seed)
    assert pd.concat([X, pd.Series(y)], axis=1).duplicated(keep=False).mean() > 0.5
    assert doubt_rows(X, y[:, None], False, False) == []


def test_chances_are_those_of_shuffled_rows():
    # learnt are 4 of 7 rows; new ones beyond the second of those learnt
    shuffles = [np.array(order) for order in permutations(range(7))]
    beyond = [int((order[4:] > np.sort(order[:4])[-2]).sum()) for order in shuffles]
    for k in (2, 3):  # fewer are no more than usual
        assert _chance(k, 3, 2, 4) == pytest.approx(np.mean(np.array(beyond) >= k))
    # of rows a, b, c, d, d, d, e one label is learnt with two rows or none
    labels = np.array(list("abcddde"))
    for learnt in (["d", "d", "d", "a"], ["a", "b", "c", "e"]):
        new = [*labels]
        for label in learnt:
            new.remove(label)
        counts = dict(zip(*np.unique(learnt, return_counts=True), strict=True))
        once = [sum(label in "abce" for label in labels[order[:4]]) for order in shuffles]
        most = [
            max((sum(labels == k) for k in {*labels[order]} - {*labels[order[:4]]}), default=0) for order in shuffles
        ]
        few = np.mean(np.array(once) <= sum(label in "abce" for label in learnt))
        frequent = np.mean(np.array(most) >= max(sum(labels == label) for label in {*new} - {*learnt}))
        chance = _chance_of_labels(counts, np.array(new))
        assert chance == pytest.approx(min(1, 2 * min(few, frequent)))


KINDS = {
    "normal": lambda rng, n: rng.normal(size=n),
    "5 % missing": lambda rng, n: np.where(rng.random(n) < 0.05, np.nan, rng.random(n)),
    "Pareto": lambda rng, n: 1 / rng.random(n),
    "Cauchy": lambda rng, n: rng.standard_cauchy(n),
    "Zipf labels": lambda rng, n: rng.zipf(1.5, n).astype(str),
    "rare labels": lambda rng, n: rng.geometric(0.02, n).astype(str),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sizes", [(500, 500), (500, 20_000)])
def test_exchangeable_rows_are_rarely_called_unlike(kind, sizes):
    """In at most one of a hundred files."""
    told = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        learnt, new = (pd.DataFrame({"v": KINDS[kind](rng, n)}) for n in sizes)
        told += bool(TableMemory().learn(learnt).compare(new)[1])
    assert told <= binom.ppf(0.9999, 60, 0.01)


SHIFTS = {
    "normal": lambda new: new + 1,
    "5 % missing": lambda new: np.where(np.arange(len(new)) < 0.1 * len(new), np.nan, new),
    "Pareto": lambda new: 1000 * new,
    "Cauchy": lambda new: np.append(new[1:], 1e12),
    "Zipf labels": lambda new: np.where(np.arange(len(new)) < 0.02 * len(new), "X", new),
    "rare labels": lambda new: np.array([f"n{k}" if k % 10 == 0 else label for k, label in enumerate(new)]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_shifted_rows_are_called_unlike(kind):
    told = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        learnt, new = KINDS[kind](rng, 500), SHIFTS[kind](KINDS[kind](rng, 20_000))
        told += bool(TableMemory().learn(pd.DataFrame({"v": learnt})).compare(pd.DataFrame({"v": new}))[1])
    assert told >= 7


def test_remedies_for_non_exchangeable_rows():
    """The two that the warnings name: units, and calibration by the last rows."""
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


class Trees(RandomForestRegressor):
    def predict_quantiles(self, X, levels):
        return np.quantile([tree.predict(np.asarray(X)) for tree in self.estimators_], levels, axis=0).T


class Extra(ExtraTreesRegressor):
    predict_quantiles = Trees.predict_quantiles


class Boosted(HistGradientBoostingRegressor):
    def predict_quantiles(self, X, levels):
        return self.predict(X)[:, None] + np.array(levels) - 0.5


class Linear(BayesianRidge):
    def predict_quantiles(self, X, levels):
        mean, sd = self.predict(np.asarray(X), return_std=True)
        return norm.ppf(levels, mean[:, None], sd[:, None])


MODELS = {
    "forest": Trees(40, min_samples_leaf=3, random_state=0), "grown forest": Trees(40, random_state=0),
    "extra trees": Extra(40, random_state=0), "boosting": Boosted(max_iter=400, random_state=0), "linear": Linear(),
}  # fmt: skip


@pytest.mark.parametrize("framed", [False, True])
@pytest.mark.parametrize("name", MODELS)
def test_model_fitted_on_calibration_rows_warns(name, framed):
    rng = np.random.default_rng(0)
    X = rng.normal(size=(4000, 4))
    y = X[:, 0] + np.sin(2 * X[:, 1]) + rng.normal(size=4000)
    model = FrozenEstimator(MODELS[name].fit(X[:1500], y[:1500]))
    held = {}
    for rows in (slice(0, 1500), slice(1500, 3000)):
        given = pd.DataFrame(X[rows]) if framed else X[rows]
        with warnings.catch_warnings(record=True) as words:
            warnings.simplefilter("always", DataWarning)
            reg = ConformalRegressor(model, random_state=0).fit(given, y[rows])
        told = any("learnt from these samples" in str(one.message) for one in words)
        held[told] = reg.predict_region(X[3000:]).contains(y[3000:]).mean()
    if name == "linear":  # which fits 1500 rows no closer than others
        assert held.keys() == {False}
    else:
        assert held[True] < 0.8 < 0.87 < held[False]
