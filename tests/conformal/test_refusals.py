"""What the conformal core refuses, each by the name of the argument: one row per argument and fault."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.tree import DecisionTreeClassifier

import conformodal.conformal as cm
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.diagnostics.coverage import coverage_by_group, coverage_by_size
from conformodal.conformal.diagnostics.diagnosis import summarise_sizes
from conformodal.conformal.diagnostics.slab import worst_slab
from conformodal.conformal.diagnostics.uniformity import check_uniformity
from tests.helpers import Missing

RNG = np.random.default_rng(0)
N, K = 80, 8
BINS = cm.QuantileBins.from_edges([np.arange(K + 1) ** 2 / 8, np.arange(K + 1) / 4])
ONE = cm.QuantileBins.from_edges([np.arange(K + 1) / 8])
P = RNG.dirichlet(np.ones(K), (N, 2))
Y = RNG.uniform(0, 2, (N, 2))
X = RNG.uniform(-4, 4, (N, 3))
W = RNG.uniform(0.1, 4, N)
HELD = RNG.random(N) < 0.9
SPLIT = cm.SplitConformal(BINS, 0.2).calibrate(P, Y)
REGIONS = SPLIT.predict(P)
MONDRIAN = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, np.arange(N) % 3)
WEIGHTED = cm.WeightedConformal(BINS, 0.2).calibrate(P, Y, W)
CONDITIONAL = cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, W)
NAMED = cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, pd.DataFrame({"a": W, "b": W}))
CROSS = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, np.arange(N) % 3)
NOVELTY = cm.NoveltyTest(X, np.arange(N) % 3)
MASKS = [np.ones((2, K), bool)] * 2


def tree():
    return cm.ConformalRegressor(
        DecisionTreeClassifier(max_depth=3, random_state=0), n_bins=4, alpha=0.3, random_state=0
    )


FITTED = tree().fit(X, Y)


def split(p, y, **settings):
    return cm.SplitConformal(BINS, **settings).calibrate(p, y)


def spoilt(values, with_value):
    values = values.copy()
    values.flat[-1] = with_value
    return values


def uncalibrated():
    return cm.ConformalRegressor(DecisionTreeClassifier(), calibration_size=0).fit(X, Y)


RATES = [
    np.float64(0.1), np.float32(0.1), np.float16(0.1), np.longdouble("0.1"), np.array(0.1), np.array(0.1, ">f4"),
    "0.1", "1/10", "1e-1", Decimal("0.1"), Fraction(1, 10),
]  # fmt: skip
NO_RATES = [
    True, np.array(True), 0.1 + 0j, np.complex64(0.1), [0.1], np.array([0.1]), None, b"0.1", np.ma.masked,
    float("nan"), float("inf"), Decimal("NaN"), Decimal("sNaN"), 0, 1.0, 10, -0.1, "1/0", "1e-999999999",
    Decimal("1e-999999999"), "ten percent", object(), np.datetime64("2020-01-01"),
]  # fmt: skip
TAKES_RATE = [
    as_alpha,
    lambda a: cm.SplitConformal(BINS, a),
    SPLIT.at,
    lambda a: cm.OnlineConformal(BINS, a),
    lambda a: cm.OnlineConformal(BINS, a, method="pid"),
    cm.ConformalPid,
    lambda a: cm.conformal_rank(9, a),
    lambda a: cm.grouped_quantile([[1.0]], a),
    lambda a: cm.coverage_band(9, 9, a),
]


@pytest.mark.parametrize("take", TAKES_RATE)
def test_rates_are_read_as_the_decimal_they_are_written_as_or_refused(take):
    for rate in RATES:
        take(rate)
        assert as_alpha(rate) == Fraction(1, 10)
    for rate in NO_RATES:
        with pytest.raises(cm.ConformalError, match="alpha"):
            take(rate)


NO_COUNTS = [True, 2.0, "3", None, -1, 0, [3], float("nan"), 1j, np.array([3]), np.ma.masked]
NO_NUMBERS = [None, "0.1", 1j, float("nan"), [0.1], True, np.array([0.1]), np.ma.masked, -1.0, float("inf")]
COUNTS = {
    "n_bins": lambda v: cm.QuantileBins(v).fit(Y),
    "n_bins of a regressor": lambda v: tree().set_params(n_bins=v).fit(X, Y) if v is not None else cm.QuantileBins(v),
    "refine": BINS.refine,
    "strata": lambda v: coverage_by_size(HELD, W, 99, 0.1, strata=v),
    "repeats": lambda v: check_uniformity(W, W, v),
    "cells": lambda v: cm.SplitConformal(BINS, 0.1, cm.LinearDensity(v)),
    "n_test": lambda v: cm.coverage_band(9, v, 0.1),
}
NUMBERS = {
    "margin": lambda v: cm.QuantileBins(3, margin=v),
    "sigma_bins": lambda v: BINS.soft_targets(Y, v),
    "gamma": lambda v: cm.Aci(gamma=v),
    "rate": lambda v: cm.ConformalPid(rate=v),
    "saturation": lambda v: cm.ConformalPid(saturation=v),
    "integral_gain": lambda v: cm.ConformalPid(integral_gain=v),
    "level": lambda v: cm.coverage_band(9, 9, 0.1, v),
    "mass": lambda v: worst_slab(HELD, X, 9, 0.1, v),
    "own_share": lambda v: cm.Aps(own_share=v),
    "calibration_size": lambda v: tree().set_params(calibration_size=v).fit(X, Y),
}
SCALARS = [(call, "whole number", NO_COUNTS) for call in COUNTS.values()]
SCALARS += [(call, name, NO_NUMBERS) for name, call in NUMBERS.items()]


@pytest.mark.parametrize(("call", "says", "wrong"), SCALARS, ids=[*COUNTS, *NUMBERS])
def test_what_is_not_a_count_or_a_number_is_refused_by_name(call, says, wrong):
    for value in wrong:
        with pytest.raises(cm.ConformalError, match=says):
            call(value)


@pytest.mark.parametrize("count", ["n_bins", "n_bins of a regressor", "refine", "cells"])
def test_counts_too_large_are_refused_before_memory_goes(count):
    with pytest.raises(cm.ConformalError, match="whole number"):
        COUNTS[count](3 * 10**9)


REFUSED = [
    # bins
    (lambda: cm.QuantileBins.from_edges([[0, np.inf]]), "finite"),
    (lambda: cm.QuantileBins.from_edges([[0]]), "at least two"),
    (lambda: cm.QuantileBins.from_edges([[0.0, 0.0]]), "increasing"),
    (lambda: cm.QuantileBins.from_edges([]), "at least one"),
    (lambda: cm.QuantileBins.from_edges([[-1.7e308, 1.7e308]]), "distances"),
    (lambda: cm.QuantileBins(3).fit([-1.7e308, 1.7e308]), "target 0"),
    (lambda: cm.QuantileBins(3, margin=1e308).fit([0.0, 100.0]), "target 0"),
    (lambda: cm.QuantileBins(3).fit(np.empty((3, 0))), "d >= 1"),
    (lambda: cm.QuantileBins(5).fit([]), "at least one"),
    (lambda: cm.QuantileBins(5).fit([1.0, np.nan]), "row 1"),
    (lambda: cm.QuantileBins(5).fit(np.zeros((2, 2, 2))), "shape"),
    (lambda: cm.QuantileBins(5).fit([1.0, 2.0]).encode(np.zeros((3, 2))), "expected 1"),
    # ranks and quantiles
    (lambda: cm.conformal_rank(10, 90), r"did you mean 0\.1"),
    (lambda: cm.conformal_rank(-1, 0.1), "n must be"),
    (lambda: cm.conformal_quantile([1.0], 0.1, axis=3), "axis"),
    (lambda: cm.grouped_quantile([[1.0]], 0.1, [2.7]), "whole number"),
    (lambda: cm.grouped_quantile(5, 0.1), "vector of scores"),
    (lambda: cm.grouped_quantile([[1.0], []], 0.1), "group 1"),
    (lambda: cm.grouped_quantile([[1.0], [[1.0]]], 0.1), "group 1"),
    (lambda: cm.grouped_quantile([[1.0], [np.nan]], 0.1), "NaN"),
    # calibrators
    (lambda: split(spoilt(P, np.nan), Y), "NaN"),
    (lambda: split(P * 2, Y), "sum to 1"),
    (lambda: split(P - 0.5, Y), "negative"),
    (lambda: split(P[:, :1], Y), r"shape \(n, 2, K\)"),
    (lambda: split(P[:, :, :-1], Y), "8 bins"),
    (lambda: split(P, Y[:-1]), "y has"),
    (lambda: split(P, Y[:, :1]), "expected 2"),
    (lambda: split(P, spoilt(Y, np.inf)), "finite"),
    (lambda: cm.SplitConformal(BINS).calibrate_scores(np.zeros(3)), "scores must have shape"),
    (lambda: cm.SplitConformal(BINS, joint="max").calibrate(P, Y), "fit_scale"),
    (lambda: cm.SplitConformal([0, 1]), "QuantileBins"),
    (lambda: cm.SplitConformal(BINS, 0.1, cm.Lac), "score"),
    (lambda: cm.SplitConformal(BINS, score="best"), "score"),
    (lambda: cm.SplitConformal(BINS, joint="all"), "joint"),
    (lambda: cm.SplitConformal(BINS, 0.1, joint=["none"]), "joint"),
    (lambda: cm.SplitConformal(BINS, 0.1, empty=np.array(["mode", "allow"])), "empty"),
    (lambda: SPLIT.regions_at(P, [np.nan, 0.5]), "NaN"),
    (lambda: cm.WeightedConformal(BINS).calibrate(P, Y, W + np.inf), "weights must be"),
    (lambda: cm.WeightedConformal(BINS).calibrate(P, Y, -W), "weights must be"),
    (lambda: cm.WeightedConformal(BINS).calibrate(P, Y, W[:3]), "shape"),
    (lambda: WEIGHTED.predict(P, W[:2]), "one entry per row"),
    (lambda: cm.ConditionalConformal(BINS).calibrate(P, Y, W[:3]), "one row per sample"),
    (lambda: cm.ConditionalConformal(BINS).calibrate(P[:0], Y[:0], W[:0]), "at least one"),
    (lambda: NAMED.predict(P, pd.DataFrame({"a": W, "c": W})), "must have the columns"),
    (lambda: cm.ConditionalConformal(BINS).calibrate(P, Y, W * np.nan), "conditions"),
    (lambda: cm.ConditionalConformal(BINS).calibrate(P, Y, [["a"]] * N), "conditions"),
    (lambda: cm.ConditionalConformal(BINS).thresholds([[1]]), "call calibrate first"),
    (lambda: CONDITIONAL.predict(P, np.ones((N, 2))), "1 columns as in calibration"),
    (lambda: CONDITIONAL.predict(P, W[:2]), "conditions must have one entry per row"),
    (lambda: NAMED.predict(P, pd.DataFrame({"b": W, "a": W})), "another order"),
    (lambda: cm.ConformalRegressor(groups=["a", "b"]).fit(X, Y), "ConditionalConformal for groups that overlap"),
    (lambda: cm.MondrianConformal(BINS).calibrate(P, Y, [1]), "groups must have one label"),
    (lambda: CROSS.predict(P), "mapping"),
    (lambda: CROSS.predict({}), "must name the folds"),
    (lambda: cm.CrossConformal(BINS).calibrate(P[:0], Y[:0], []), "at least one"),
    # regions
    (lambda: cm.Regions(BINS, MASKS[:1], np.zeros((2, 2), bool)), "one array per target"),
    (lambda: cm.Regions(BINS, [MASKS[0], MASKS[0][:, :3]], np.zeros((2, 2), bool)), "mask of target 1"),
    (lambda: cm.Regions(BINS, MASKS, np.zeros((2, 1), bool)), "unbounded"),
    (lambda: cm.Regions(ONE, [np.ones((2, K))], np.zeros((2, 1), bool)), "boolean"),
    (lambda: cm.Regions(ONE, [np.ma.array(MASKS[0], mask=MASKS[0])], np.zeros((2, 1), bool)), "masked"),
    (lambda: REGIONS.contains(Y[:2]), "2 rows"),
    (lambda: REGIONS.intervals(N), "sample"),
    (lambda: REGIONS.intervals(1.0), "sample"),
    (lambda: REGIONS.flat_intervals(7), "target"),
    (lambda: REGIONS[[0, N]], "index"),
    (lambda: REGIONS[np.array([0.0])], "indexed"),
    (lambda: REGIONS[[True, False]], "index"),
    (lambda: cm.Regions.concatenate([1, 2]), "Regions"),
    (lambda: REGIONS.mapped(np.log), "finite at all edges of the bins, got -inf at 0, target 0"),
    (lambda: REGIONS.mapped(lambda v: v[:2]), "shape"),
    # diagnostics
    (lambda: cm.diagnose(MONDRIAN, P, Y), "groups are needed"),
    (lambda: cm.diagnose(SPLIT, P, Y, names=5), "name per target"),
    (lambda: cm.diagnose(SPLIT, P, Y, names=["a"]), "names"),
    (lambda: cm.diagnose(SPLIT, P, Y, names="ab"), "one name per target .2., got 'ab'"),
    (lambda: cm.diagnose(SPLIT, P, Y, X[:7]), "X must"),
    (lambda: cm.diagnose(SPLIT, P, Y, groups=[1]), "groups"),
    (lambda: cm.diagnose(SPLIT, P[:0], Y[:0]), "at least one"),
    (lambda: cm.check_coverage([0.0, np.nan], 9, 0.1), "boolean"),
    (lambda: cm.check_coverage(HELD[:0], 9, 0.1), "at least one sample"),
    (lambda: coverage_by_group(["no"], ["a"], 9, 0.1), "boolean"),
    (lambda: coverage_by_size(HELD, [1.0], 9, 0.1), "sizes must have"),
    (lambda: coverage_by_size(HELD, np.full(N, np.nan), 9, 0.1), "NaN"),
    (lambda: worst_slab(HELD[:1], np.ones((1, 1)), 9, 0.1), "at least 2"),
    (lambda: check_uniformity([], [1.0]), "calibration_scores"),
    (lambda: check_uniformity([1.0], [np.nan]), "test_scores"),
    (lambda: check_uniformity(W, W, 9, "x"), "random_state"),
    (lambda: summarise_sizes(SPLIT.predict(P[:0])), "at least one"),
    (lambda: cm.grouped_coverage_band([1, 2], 0.1), "pairs"),
    (lambda: cm.grouped_coverage_band([(9, 0)], 0.1), "needs test samples"),
    (lambda: cm.grouped_coverage_band([(9, 3)], 0.1, 1.0), "level"),
    # novelty
    (lambda: cm.NoveltyTest(np.zeros(3), [0, 1, 2]), r"shape \(n, k\)"),
    (lambda: cm.NoveltyTest(np.empty((0, 2)), []), "references must be finite"),
    (lambda: cm.NoveltyTest([[0.0], [np.nan]], [0, 1]), "references must be finite"),
    (lambda: cm.NoveltyTest([[0.0], [1.0]], [0]), "one label per sample"),
    (lambda: cm.NoveltyTest([[0.0], [1.0]], [5, 5]), "two groups"),
    (lambda: NOVELTY.scores(np.zeros((1, 2))), r"samples must have shape \(m, 3\)"),
    (lambda: NOVELTY.scores(X + np.inf), "finite"),
    (lambda: NOVELTY.scores(X * 1e200), "1e150"),
    # online
    (lambda: cm.OnlineConformal(BINS, method=5), "method"),
    (lambda: cm.OnlineConformal(BINS, method="dtaci"), "method"),
    (lambda: cm.OnlineConformal(BINS, method=lambda a: 5), "Tracker"),
    (lambda: cm.Aci(0.1, 0), "gamma"),
    (lambda: cm.Aci(window=2.5), "window"),
    (lambda: cm.ConformalPid(start=np.nan), "start"),
    # regressors and densities
    (lambda: cm.ConformalRegressor(5).fit(X, Y), "estimator"),
    (lambda: cm.ConformalRegressor(DecisionTreeClassifier).fit(X, Y), "estimator"),
    (lambda: tree().set_params(joint="foo").fit(X, Y), "joint must be one of.*got 'foo'"),
    (lambda: FITTED.predict_region(X, alpha=[]), "alpha must hold at least one"),
    (lambda: tree().fit(X[:2], Y[:2]), "n_samples=2"),
    (lambda: tree().fit(X * 1e39, Y), "cannot be fitted"),
    (lambda: FITTED.predict(X * 1e39), "cannot predict"),
    (lambda: tree().fit(X, Y, W[:5]), "sample_weight.*shape"),
    (lambda: tree().fit(X, Y, -W), "sample_weight.*Negative"),
    (lambda: tree().fit(X, Y, W + np.inf), "sample_weight.*infinity"),
    (lambda: tree().fit(X, Y, 0 * W), "sample_weight.*zero"),
    (lambda: tree().fit(X, Y, ["a"] * N), "sample_weight must be numeric"),
    (lambda: cm.StackedDensity().fit_bins(X * 1e39, W, [0, 1]), "float32"),
    (lambda: cm.StackedDensity().fit_bins(X, W * 1e300, [0, 1]), "spread"),
    (lambda: cm.StackedDensity().fit_bins(X, W[:5], [0, 1]), "row of X"),
    (lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], W[:3]), "shape"),
    (lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], -W), "Negative"),
    (lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], W * np.nan), "NaN"),
    (lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], 0 * W), "zero"),
    (lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], np.eye(N)[0]), "at least 2 rows"),
    (lambda: cm.QuickDensity(max_rows=1).fit_bins(X, W, [0, 1]), "max_rows"),
    (lambda: cm.QuickDensity().fit_bins(X, W[:3], [0, 1]), "one value per row"),
]


@pytest.mark.parametrize(("call", "says"), REFUSED)
@pytest.mark.filterwarnings("error")
def test_refused(call, says):
    with pytest.raises(cm.ConformalError, match=says):
        call()


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda: cm.QuantileBins(5).encode([1.0]), cm.NotCalibratedError),
        (lambda: cm.SplitConformal(BINS).predict(P), cm.NotCalibratedError),
        (lambda: cm.DriftMonitor(cm.SplitConformal(BINS)), cm.NotCalibratedError),
        (lambda: uncalibrated().predict_region(X), cm.NotCalibratedError),
        (lambda: uncalibrated().diagnose(X, Y), cm.NotCalibratedError),
        (lambda: cm.QuickDensity().predict_proba(X), NotFittedError),
    ],
)
def test_what_is_not_calibrated_or_fitted_has_its_own_error(call, error):
    with pytest.raises(error):
        call()


@pytest.mark.parametrize("make", [cm.Aci, cm.ConformalPid])
def test_trackers_learn_nothing_from_what_is_not_a_score(make):
    tracker = make(0.1)
    for s in (0.5, 0.7, np.float32(0.6), np.array(0.4), Fraction(1, 2)):
        tracker.update(s)
    before = tracker.threshold()
    for score in (np.nan, None, "1", 1j, [1.0], np.array([1.0]), np.ma.masked, Missing(), 10**400, True):
        with pytest.raises(cm.ConformalError, match="score"):
            tracker.update(score)
    assert tracker.threshold() == before
    assert len(tracker.past) == 5


class Odd:
    """A score of one's own whose values are replaced."""

    name = "odd"

    def __init__(self, give):
        self.give = give

    def of_bins(self, proba, widths):
        return self.give(1 - proba)


OWN = {
    "NaN": lambda s: s * np.nan,
    "shape": lambda s: s[:, :1],
    "numeric": lambda s: s + 0j,
    "masked": lambda s: np.ma.array(s, mask=True),
}


@pytest.mark.parametrize("says", OWN)
def test_scores_of_ones_own_are_checked(says):
    odd = cm.SplitConformal(BINS, 0.1, Odd(OWN[says]))
    for call in (lambda: odd.regions_at(P, [0.5, 0.5]), lambda: odd.calibrate(P, Y)):
        with pytest.raises(cm.ConformalError, match=says):
            call()
