"""Arrays of unusual type at every entry of the conformal core: the same answer as plain ones, or a typed error.

Tables: every entry (a function of one array) x every disguise of good numbers, and x every kind of bad ones. Numbers
are multiples of powers of two, so that all floating types hold them exactly.
"""

import pickle
import warnings
from collections import deque
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import sparse
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import (
    Aci,
    Aps,
    ConformalError,
    ConformalPid,
    ConformalRegressor,
    CrossConformal,
    Density,
    Lac,
    LinearDensity,
    MondrianConformal,
    NoveltyTest,
    OnlineConformal,
    QuantileBins,
    Regions,
    SplitConformal,
    StackedDensity,
    WeightedConformal,
    check_coverage,
    conformal_quantile,
    conformal_rank,
    coverage_band,
    diagnose,
    grouped_coverage_band,
    grouped_maximum_quantile,
    grouped_quantile,
    weighted_quantile,
)
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.diagnostics.coverage import coverage_by_group, coverage_by_size
from conformodal.conformal.diagnostics.slab import worst_slab
from conformodal.conformal.diagnostics.uniformity import check_uniformity
from conformodal.conformal.scores import SCORES
from tests.helpers import Missing

RNG = np.random.default_rng(0)
N, D, K = 80, 2, 8
BINS = QuantileBins.from_edges([np.arange(K + 1) ** 2 / 8, np.arange(K + 1) / 4])
ONE = QuantileBins.from_edges([np.arange(K + 1) / 8])
P = RNG.multinomial(64, RNG.dirichlet(np.ones(K), (N, D))) / 64
Y = RNG.integers(0, 32, (N, D)) / np.array([4, 16])
G = RNG.integers(0, 3, N)
X = RNG.integers(-32, 32, (N, 3)) / 8
W = RNG.integers(1, 32, N) / 8
HELD = RNG.random(N) < 0.9


def seen(regions):
    return [*map(np.asarray, regions.masks), regions.unbounded]


def split(score="density", joint="none", **kwargs):
    cal = SplitConformal(BINS, 0.2, score, joint, **kwargs)
    if joint == "max":
        cal.fit_scale(P[:40], Y[:40])
    return cal.calibrate(P, Y)


def tree():
    return ConformalRegressor(DecisionTreeClassifier(max_depth=3, random_state=0), n_bins=4, alpha=0.3, random_state=0)


FITTED = tree().fit(X, Y[:, 0])
SPLIT = {score: split(score) for score in SCORES}
JOINT, FULL = split(joint="max"), split(empty="mode")
NOVELTY = NoveltyTest(X, G)
MONDRIAN = MondrianConformal(BINS, 0.2).calibrate(P, Y, G)
WEIGHTED = WeightedConformal(BINS, 0.2).calibrate(P, Y, W)
CROSS = CrossConformal(BINS, 0.2).calibrate(P, Y, G)
REGIONS = SPLIT["lac"].predict(P)
ONLINE = OnlineConformal(BINS, 0.2)
ONLINE.update(P, Y)

# one argument of a public function: good values for it, and what the function makes of them
ENTRIES = {
    **{f"predict {score}": (P, lambda p, cal=cal: seen(cal.predict(p))) for score, cal in SPLIT.items()},
    "predict, few rows": (P[:3], lambda p: seen(SPLIT["lac"].predict(p))),
    "predict, joint max": (P, lambda p, cal=JOINT: seen(cal.predict(p))),
    "predict, empty mode": (P, lambda p, cal=FULL: seen(cal.predict(p))),
    "predict, one target": (P[:, 0], lambda p: seen(SplitConformal(ONE).calibrate(P[:, 0], Y[:, 0]).predict(p))),
    "predict, a list": (P[:, 0], lambda p: seen(SPLIT["density"].predict([p, P[:, 1]]))),
    "calibrate proba": (P, lambda p: [SplitConformal(BINS, 0.2).calibrate(p, Y).thresholds_]),
    "calibrate y": (Y, lambda y: [SplitConformal(BINS, 0.2).calibrate(P, y).thresholds_]),
    "calibrate_scores": (P[:, :, 0], lambda s: [SplitConformal(BINS, 0.2).calibrate_scores(s).thresholds_]),
    "fit_scale": (P, lambda p: [SplitConformal(BINS, 0.2, joint="max").fit_scale(p, Y).rule.scale_]),
    "p_values": (P, lambda p: [SPLIT["lac"].p_values(p, Y)]),
    "regions_at": (Y[0] / 8, lambda t: seen(SPLIT["lac"].regions_at(P, t))),
    "mondrian calibrate": (P, lambda p: list(MondrianConformal(BINS, 0.2).calibrate(p, Y, G).thresholds_.values())),
    "mondrian predict": (P, lambda p: seen(MONDRIAN.predict(p, G))),
    "weights": (W, lambda w: [WeightedConformal(BINS, 0.2).calibrate(P, Y, w).thresholds([1.0])]),
    "new weights": (W, lambda w: seen(WEIGHTED.predict(P, w))),
    "cross calibrate": (P, lambda p: list(CrossConformal(BINS, 0.2).calibrate(p, Y, G).scores_.values())),
    "cross predict": (P, lambda p: seen(CROSS.predict({0: p, 1: P, 2: P}))),
    "online run": (P, lambda p: seen(OnlineConformal(BINS, 0.2).run(p, Y))),
    "online y": (Y, lambda y: [OnlineConformal(BINS, 0.2).update(P, y).thresholds]),
    "bins fit": (Y, lambda y: QuantileBins(4).fit(y).edges_),
    "bins edges": (np.arange(9) / 8, lambda e: QuantileBins.from_edges([e]).edges_),
    "bins encode": (Y, lambda y: [BINS.encode(y)]),
    "bins soft targets": (Y, lambda y: BINS.soft_targets(y, 1.5)),
    "contains": (Y, lambda y: [REGIONS.contains(y)]),
    "conformal_quantile": (W, lambda s: [conformal_quantile(s, 0.2)]),
    "weighted_quantile scores": (W, lambda s: [weighted_quantile(s, W, [1.0], 0.2)]),
    "weighted_quantile weights": (W, lambda w: [weighted_quantile(W, w, w, 0.2)]),
    "grouped_quantile": (W, lambda s: [grouped_quantile([s, W], 0.4)]),
    "grouped_maximum_quantile": (W, lambda s: [grouped_maximum_quantile([s, W], 0.4)]),
    "novelty references": (X, lambda x: [NoveltyTest(x, G).scores_]),
    "novelty scores": (X, lambda x: [NOVELTY.scores(x)]),
    "novelty p_values": (W, lambda s: [NOVELTY.p_values(s)]),
    "uniformity": (W, lambda s: [check_uniformity(s, W, 9).p_values]),
    "slab": (X, lambda x: [worst_slab(HELD, x, 99, 0.1, directions=5).direction]),
    "strata": (W, lambda s: list(coverage_by_size(HELD, s, 99, 0.1))),
    "diagnose": (P, lambda p: [str(diagnose(SPLIT["lac"], p, Y))]),
    "diagnose y": (Y, lambda y: [str(diagnose(SPLIT["lac"], P, y))]),
    "regressor X": (X, lambda x: [tree().fit(x, Y).predict(X)]),
    "regressor y": (Y, lambda y: [tree().fit(X, y).predict(X)]),
    "regressor conformalize": (X, lambda x: [FITTED.conformalize(x, Y[:, 0]).calibrator_.thresholds_]),
    "regressor predict": (X, lambda x: [FITTED.predict(x), *seen(FITTED.predict_region(x))]),
    "of_bins lac": (P[:, 0], lambda p: [Lac().of_bins(p, np.ones(K))]),
    "of_bins density": (P[:, 0], lambda p: [Density().of_bins(p, np.ones(K))]),
    "of_bins linear": (P[:, 0], lambda p: [LinearDensity().of_bins(p, np.ones(K))]),
    "of_bins aps": (P[:, 0], lambda p: [Aps("density").of_bins(p, np.ones(K))]),
}


class Frame:
    """Stands for a table of another library: NumPy learns its numbers through ``__array__`` alone."""

    def __init__(self, values):
        self.values = values
        self.shape, self.ndim = np.shape(values), np.ndim(values)

    def __len__(self):
        return len(self.values)

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)


class Units(np.ndarray):
    """A subclass of arrays."""


def strided(a):
    twice = np.zeros((2 * len(a), *a.shape[1:]), a.dtype)
    twice[::2] = a
    return twice[::2]


def readonly(a):
    a = a.copy()
    a.flags.writeable = False
    return a


def objects(kind):
    return lambda a: np.array([kind(float(v)) for v in a.ravel()] + [None], object)[:-1].reshape(a.shape)


LONG = {  # of float64
    "big-endian": lambda a: a.astype(">f8"),
    "longdouble": lambda a: a.astype(np.longdouble),
    "columns first": np.asfortranarray,
    "strided": strided,
    "backwards": lambda a: a[::-1].copy()[::-1],
    "read-only": readonly,
    "subclass": lambda a: a.view(Units),
    "no masked entry": np.ma.array,
    "lists": lambda a: a.tolist(),
    "objects": lambda a: a.astype(object),
    "fractions": objects(Fraction),
    "decimals": objects(Decimal),
    "frame": Frame,
    "frame of objects": lambda a: Frame(a.astype(object)),
    "tensor": torch.from_numpy,
    "tensor with gradient": lambda a: torch.from_numpy(a.copy()).requires_grad_(),
    "memory view": memoryview,
    "unpickled": lambda a: pickle.loads(pickle.dumps(a.astype(">f8"))),
}
SHORT = {  # of float32
    "big-endian 4": lambda a: a.astype(">f4"),
    "half": lambda a: a.astype(np.float16),
    "big-endian half": lambda a: a.astype(">f2"),
    "tensor 4": lambda a: torch.from_numpy(a.copy()),
    "tensor half": lambda a: torch.from_numpy(a.copy()).half(),
}
# scikit-learn has its own rules for these
NOT_TABLES = {"tensor with gradient", "memory view"}
DISGUISES = [(k, f, np.float64) for k, f in LONG.items()] + [(k, f, np.float32) for k, f in SHORT.items()]


@cache
def expected_of(entry, plain):
    good, call = ENTRIES[entry]
    return call(good.astype(plain))


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize(("disguise", "put_on", "plain"), DISGUISES, ids=[d[0] for d in DISGUISES])
def test_the_same_numbers_give_the_same_answer(entry, disguise, put_on, plain):
    good, call = ENTRIES[entry]
    if entry.startswith("regressor") and disguise in NOT_TABLES:
        return
    values = good.astype(plain)
    given = put_on(values)
    expected, found = expected_of(entry, plain), call(given)
    assert len(expected) == len(found)
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
        assert np.asarray(a).dtype == np.asarray(b).dtype


def replaced(value):
    def put(a):
        bad = a.astype(object)
        bad.flat[-1] = value
        return bad

    return put


def masked(a):
    mask = np.zeros(a.shape, bool)
    mask.flat[-1] = True
    return np.ma.array(a, mask=mask)


def with_float(value):
    def put(a):
        bad = a.copy()
        bad.flat[-1] = value
        return bad

    return put


ENDLESS = []
ENDLESS.append(ENDLESS)
BAD = {
    "complex": lambda a: a + 1j,
    "text": lambda a: a.astype(str),
    "bytes": lambda a: a.astype(bytes),
    "dates": lambda a: (a * 64).astype("M8[D]"),
    "times": lambda a: (a * 64).astype("m8[s]"),
    "records": lambda a: np.zeros(a.shape, [("a", float)]),
    "masked": masked,
    "masked rows in a list": lambda a: list(masked(a)),
    "None": replaced(None),
    "NA": replaced(Missing()),
    "complex among numbers": replaced(1j),
    "integer too large": replaced(10**400),
    "decimal sNaN": replaced(Decimal("sNaN")),
    "date among numbers": replaced(np.datetime64("2020-01-01")),
    "array among numbers": lambda a: replaced(a)(a),
    "NaN": with_float(np.nan),
    "ragged": lambda a: [*a.tolist(), [0.5, [0.5]]],
    "generator": lambda a: (row for row in a),
    "dict": lambda a: dict(enumerate(a.tolist())),
    "None alone": lambda a: None,
    "number": lambda a: 0.5,
    "0-d": lambda a: np.array(0.5),
    "empty list of lists": lambda a: [[], []],
    "an axis too many": lambda a: a[None, None, None],
    "sparse": lambda a: sparse.csr_array(a.reshape(len(a), -1)),
    "frame of NA": lambda a: Frame(replaced(Missing())(a)),
    "complex tensor": lambda a: torch.from_numpy(a + 0j),
    "sparse tensor": lambda a: torch.from_numpy(a.copy()).to_sparse(),
    "meta tensor": lambda a: torch.empty(a.shape, device="meta"),
    "self-holding list": lambda a: ENDLESS,
}


INNER = "of_bins"  # its callers have checked the numbers


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("damage", BAD)
def test_what_is_no_array_of_real_numbers_is_refused(entry, damage):
    good, call = ENTRIES[entry]
    if damage == "an axis too many" and entry.startswith(("novelty p", "conformal_q", INNER)):
        return  # these work along an axis, or element by element
    if damage in ("NaN", "sparse") and entry in ("regressor X", "regressor conformalize", "regressor predict"):
        return  # which a tree can learn from
    if (damage, entry) == ("empty list of lists", "conformal_quantile"):
        return  # two scores for none
    if damage in ("NaN", "empty list of lists", "0-d", "number") and entry.startswith((INNER, "novelty p")):
        return
    with pytest.raises(ConformalError) as told:
        call(BAD[damage](good))
    assert 0 < len(str(told.value).splitlines()[0]) < 400


# nested lists whose first two sizes agree: what NumPy makes of them, samples first
@pytest.mark.parametrize(
    ("cal", "extra"),
    [(SPLIT["lac"], ()), (ONLINE, ()), (MONDRIAN, ([0, 1],))],
)
def test_lists_of_as_many_samples_as_targets_are_samples_first(cal, extra):
    rows = P[:D]
    expected = seen(cal.predict(rows, *extra))
    for nested in (rows.tolist(), tuple(map(tuple, rows.tolist()))):
        for a, b in zip(expected, seen(cal.predict(nested, *extra)), strict=True):
            np.testing.assert_array_equal(a, b)
    # arrays in a list are one per target, as documented, and so are lists that can be nothing else
    np.testing.assert_array_equal(seen(cal.predict([rows[:, 0], rows[:, 1]], *extra))[0], expected[0])


def test_lists_of_other_sizes_are_one_per_target():
    forms = [P[:5, 0].tolist(), P[:5, 1].tolist()]
    np.testing.assert_array_equal(seen(SPLIT["lac"].predict(forms))[0], seen(SPLIT["lac"].predict(P[:5]))[0])
    bins = QuantileBins.from_edges([np.arange(3.0), np.arange(4.0)])
    cal = SplitConformal(bins).calibrate([np.full((9, 2), 0.5), np.full((9, 3), 1 / 3)], np.full((9, 2), 0.5))
    assert cal.predict([[[0.5, 0.5], [1, 0]], [[0, 0, 1], [1, 0, 0]]]).masks[1].shape == (2, 3)


NARROW = [1e-3, 1e-30, 1e-39, 1e-45, 1e-300, 1e-310, 5e-324]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("width", NARROW)
@pytest.mark.parametrize("score", SCORES)
@pytest.mark.filterwarnings("error")
def test_narrow_bins_give_no_infinite_density(score, width, dtype):
    bins = QuantileBins.from_edges([[0, width, 2 * width, 1]])
    proba = np.tile(np.array([[0.5, 0, 0.5], [0, 0, 1]], dtype), (30, 1))
    y = np.tile([0.5 * width, 0.5], 30)
    if score == "linear_density" and width == 5e-324:
        with pytest.raises(ConformalError, match="increasing"):  # a bin that float64 cannot cut
            SplitConformal(bins, 0.1, score)
        return
    cal = SplitConformal(bins, 0.1, score)
    cal.calibrate(proba, y)
    assert not np.isnan(cal.scores_).any()
    assert cal.predict(proba).contains(y).mean() >= 0.9
    assert not np.isnan(cal.predict(proba).length).any()


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
    lambda a: SplitConformal(BINS, a),
    SPLIT["lac"].at,
    lambda a: OnlineConformal(BINS, a),
    lambda a: OnlineConformal(BINS, a, method="pid"),
    ConformalPid,
    lambda a: conformal_rank(9, a),
    lambda a: grouped_quantile([[1.0]], a),
    lambda a: coverage_band(9, 9, a),
]


@pytest.mark.parametrize("take", TAKES_RATE)
def test_rates_are_read_as_the_decimal_they_are_written_as_or_refused(take):
    for rate in RATES:
        take(rate)
        assert as_alpha(rate) == Fraction(1, 10)
    for rate in NO_RATES:
        with pytest.raises(ConformalError, match="alpha"):
            take(rate)


NO_COUNTS = [True, 2.0, "3", None, -1, 0, [3], float("nan"), 1j, np.array([3]), np.ma.masked]
NO_NUMBERS = [None, "0.1", 1j, float("nan"), [0.1], True, np.array([0.1]), np.ma.masked, -1.0, float("inf")]
COUNTS = {
    "n_bins": lambda v: QuantileBins(v).fit(Y),
    "n_bins of a regressor": lambda v: tree().set_params(n_bins=v).fit(X, Y) if v is not None else QuantileBins(v),
    "refine": BINS.refine,
    "strata": lambda v: coverage_by_size(HELD, W, 99, 0.1, strata=v),
    "repeats": lambda v: check_uniformity(W, W, v),
    "cells": lambda v: SplitConformal(BINS, 0.1, LinearDensity(v)),
    "n_test": lambda v: coverage_band(9, v, 0.1),
}
NUMBERS = {
    "margin": lambda v: QuantileBins(3, margin=v),
    "sigma_bins": lambda v: BINS.soft_targets(Y, v),
    "gamma": lambda v: Aci(gamma=v),
    "rate": lambda v: ConformalPid(rate=v),
    "saturation": lambda v: ConformalPid(saturation=v),
    "integral_gain": lambda v: ConformalPid(integral_gain=v),
    "level": lambda v: coverage_band(9, 9, 0.1, v),
    "mass": lambda v: worst_slab(HELD, X, 9, 0.1, v),
    "own_share": lambda v: Aps(own_share=v),
    "calibration_size": lambda v: tree().set_params(calibration_size=v).fit(X, Y),
}
SCALARS = [(call, "whole number", NO_COUNTS) for call in COUNTS.values()]
SCALARS += [(call, name, NO_NUMBERS) for name, call in NUMBERS.items()]


@pytest.mark.parametrize(("call", "says", "wrong"), SCALARS, ids=[*COUNTS, *NUMBERS])
def test_what_is_no_count_or_number_is_refused_by_name(call, says, wrong):
    for value in wrong:
        with pytest.raises(ConformalError, match=says):
            call(value)


@pytest.mark.parametrize("count", ["n_bins", "n_bins of a regressor", "refine", "cells"])
def test_counts_too_large_are_refused_before_memory_goes(count):
    with pytest.raises(ConformalError, match="whole number"):
        COUNTS[count](3 * 10**9)


REFUSED = {
    "edges of inf": (lambda: QuantileBins.from_edges([[0, np.inf]]), "finite"),
    "one edge": (lambda: QuantileBins.from_edges([[0]]), "at least two"),
    "weights of inf": (lambda: WeightedConformal(BINS).calibrate(P, Y, W + np.inf), "finite"),
    "samples of inf": (lambda: NOVELTY.scores(X + np.inf), "finite"),
    "edges too far apart": (lambda: QuantileBins.from_edges([[-1.7e308, 1.7e308]]), "distances"),
    "values too far apart": (lambda: QuantileBins(3).fit([-1.7e308, 1.7e308]), "target 0"),
    "margin too large": (lambda: QuantileBins(3, margin=1e308).fit([0.0, 100.0]), "target 0"),
    "y without columns": (lambda: QuantileBins(3).fit(np.empty((3, 0))), "d >= 1"),
    "weights below zero": (lambda: WeightedConformal(BINS).calibrate(P, Y, -W), "at least 0"),
    "weights of another length": (lambda: WeightedConformal(BINS).calibrate(P, Y, W[:3]), "shape"),
    "new weights of another length": (lambda: WEIGHTED.predict(P, W[:2]), "one entry per row"),
    "bins that are none": (lambda: SplitConformal([0, 1]), "QuantileBins"),
    "score that is a class": (lambda: SplitConformal(BINS, 0.1, Lac), "score"),
    "diagnosis of another calibrator": (lambda: diagnose(WEIGHTED, P, Y), "Split- or Mondrian"),
    "diagnosis by groups without them": (lambda: diagnose(MONDRIAN, P, Y), "groups are needed"),
    "joint that is a list": (lambda: SplitConformal(BINS, 0.1, joint=["none"]), "joint"),
    "empty that is an array": (lambda: SplitConformal(BINS, 0.1, empty=np.array(["mode", "allow"])), "empty"),
    "method that is a number": (lambda: OnlineConformal(BINS, method=5), "method"),
    "method that makes no tracker": (lambda: OnlineConformal(BINS, method=lambda a: 5), "Tracker"),
    "thresholds of NaN": (lambda: SPLIT["lac"].regions_at(P, [np.nan, 0.5]), "NaN"),
    "proba that is no mapping": (lambda: CROSS.predict(P), "mapping"),
    "no samples to cross": (lambda: CrossConformal(BINS).calibrate(P[:0], Y[:0], []), "at least one"),
    "masks of numbers": (lambda: Regions(ONE, [np.ones((2, K))], np.zeros((2, 1), bool)), "boolean"),
    "masks that are masked": (lambda: Regions(ONE, [masked(np.ones((2, K), bool))], np.zeros((2, 1), bool)), "masked"),
    "a sample too far": (lambda: REGIONS.intervals(N), "sample"),
    "a sample that is a float": (lambda: REGIONS.intervals(1.0), "sample"),
    "a target too far": (lambda: REGIONS.flat_intervals(7), "target"),
    "positions too far": (lambda: REGIONS[[0, N]], "index"),
    "positions of floats": (lambda: REGIONS[np.array([0.0])], "indexed"),
    "a mask of another length": (lambda: REGIONS[[True, False]], "index"),
    "X too large for a tree": (lambda: tree().fit(X * 1e39, Y), "cannot be fitted"),
    "X to predict too large for a tree": (lambda: FITTED.predict(X * 1e39), "cannot predict"),
    "names that are a number": (lambda: diagnose(SPLIT["lac"], P, Y, names=5), "name per target"),
    "parts that are none": (lambda: Regions.concatenate([1, 2]), "Regions"),
    "inside of numbers": (lambda: check_coverage([0.0, np.nan], 9, 0.1), "boolean"),
    "inside of words": (lambda: coverage_by_group(["no"], ["a"], 9, 0.1), "boolean"),
    "sizes that are floats": (lambda: grouped_quantile([[1.0]], 0.1, [2.7]), "whole number"),
    "groups that are a number": (lambda: grouped_quantile(5, 0.1), "vector of scores"),
    "pairs that are none": (lambda: grouped_coverage_band([1, 2], 0.1), "pairs"),
    "axis too far": (lambda: conformal_quantile([1.0], 0.1, axis=3), "axis"),
    "seed that is a word": (lambda: check_uniformity(W, W, 9, "x"), "random_state"),
    "samples too large": (lambda: NOVELTY.scores(X * 1e200), "1e150"),
    "X too large for trees": (lambda: StackedDensity().fit_bins(X * 1e39, W, [0, 1]), "float32"),
    "y too large for a density": (lambda: StackedDensity().fit_bins(X, W * 1e300, [0, 1]), "spread"),
    "y of another length": (lambda: StackedDensity().fit_bins(X, W[:5], [0, 1]), "row of X"),
    "estimator that is a number": (lambda: ConformalRegressor(5).fit(X, Y), "estimator"),
    "estimator that is a class": (lambda: ConformalRegressor(DecisionTreeClassifier).fit(X, Y), "estimator"),
    "window of a float": (lambda: Aci(window=2.5), "window"),
    "start of NaN": (lambda: ConformalPid(start=np.nan), "start"),
}


@pytest.mark.parametrize("case", REFUSED)
@pytest.mark.filterwarnings("error")
def test_refused(case):
    call, says = REFUSED[case]
    with pytest.raises(ConformalError, match=says):
        call()


@pytest.mark.parametrize("make", [Aci, ConformalPid])
def test_trackers_learn_nothing_from_what_is_no_score(make):
    tracker = make(0.1)
    for s in (0.5, 0.7, np.float32(0.6), np.array(0.4), Fraction(1, 2)):
        tracker.update(s)
    before = tracker.threshold()
    for score in (np.nan, None, "1", 1j, [1.0], np.array([1.0]), np.ma.masked, Missing(), 10**400, True):
        with pytest.raises(ConformalError, match="score"):
            tracker.update(score)
    assert tracker.threshold() == before
    assert len(tracker.past) == 5


def test_all_zero_weights_give_unbounded_regions():
    assert WeightedConformal(BINS).calibrate(P, Y, 0 * W).predict(P, 0 * W).unbounded.all()


class Odd:
    """A score that is none: what it gives is replaced."""

    name = "odd"

    def __init__(self, give):
        self.give = give

    def of_bins(self, proba, widths):
        return self.give(1 - proba)


@pytest.mark.parametrize(
    ("give", "says"),
    [
        (lambda s: s * np.nan, "NaN"),
        (lambda s: s[:, :1], "shape"),
        (lambda s: s + 0j, "numeric"),
        (lambda s: "abc", "shape"),
        (lambda s: np.ma.array(s, mask=True), "masked"),
    ],
)
def test_scores_of_ones_own_are_checked(give, says):
    with pytest.raises(ConformalError, match=says):
        SplitConformal(BINS, 0.1, Odd(give)).regions_at(P, [0.5, 0.5])
    with pytest.raises(ConformalError, match=says):
        SplitConformal(BINS, 0.1, Odd(give)).calibrate(P, Y)


def test_edges_and_thresholds_of_another_byte_order_are_written_to_arrow():
    pytest.importorskip("pyarrow")
    bins = QuantileBins.from_edges([np.arange(4.0)])
    bins.edges_ = [bins.edges_[0].astype(">f8")]
    proba = np.tile([0.5, 0.25, 0.25], (20, 1))
    cal = SplitConformal(bins).calibrate(proba, np.full(20, 0.5))
    cal.thresholds_ = pickle.loads(pickle.dumps(cal.thresholds_.astype(">f8")))
    regions = cal.predict(proba)
    assert regions.to_arrow().column("target_0").to_pylist() == [regions.intervals(i)[0].tolist() for i in range(20)]


def test_plain_arrays_are_not_copied():
    cal = SPLIT["density"]
    from conformodal.conformal.checks import as_reals, as_table

    for dtype in (np.float32, np.float64):
        proba = P.astype(dtype)
        assert as_reals(proba, "proba") is proba
        assert all(np.shares_memory(part, proba) for part in as_table(proba, cal.bins.sizes)[0])


with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    MATRIX = np.matrix([[0.5, 0.5]])
TWO = QuantileBins.from_edges([[0, 1, 3]])
TWO_CAL = SplitConformal(TWO, 0.3).calibrate(np.tile([0.75, 0.25], (9, 1)), np.tile([0.5, 0.5, 2.0], 3))
HALVES = np.full((3, 2), 0.5)


def calibrate_on(v):
    try:
        n = len(v)
    except TypeError:
        n = 0
    cal = SplitConformal(TWO, 0.3, "density").calibrate(np.full((n, 2), 0.5), v)
    # of n calibration samples, at least k are in their own regions
    assert cal.predict(np.full((n, 2), 0.5)).contains(v).sum() >= min(cal.rank, n)
    return [cal.thresholds_]


# calls that take arrays so small that what comes by chance fits them
TINY = {
    "two bins": lambda v: [TWO_CAL.predict(v).length],
    "two bins, y": calibrate_on,
    "two bins, encode": lambda v: [TWO.encode(v), *TWO.soft_targets(v, 0.5)],
    "groups": lambda v: MondrianConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).thresholds_.values(),
    "folds": lambda v: CrossConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).scores_.values(),
    "groups of split": lambda v: [SplitConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).n_units],
    "novelty of one number": lambda v: [NoveltyTest([[0.0], [1.0]], [0, 1]).scores(v)],
    "references of two": lambda v: [NoveltyTest(v, [0, 1]).scores_],
    "three edges": lambda v: QuantileBins.from_edges(v).widths,
    "weights of two": lambda v: [weighted_quantile([1.0, 2.0], [1.0, 1.0], v, 0.3)],
    "groups of scores": lambda v: [grouped_quantile(v, 0.3)],
    "inside": lambda v: [check_coverage(v, 9, 0.1).coverage],
    "index": lambda v: [REGIONS[v].unbounded],
    "n_bins": lambda v: [QuantileBins(v).n_bins],
    "alpha": lambda v: [float(as_alpha(v))],
    "score of a tracker": lambda v: [Aci(0.1).update(v) is None],
    "regressor of three": lambda v: [tree().fit(X[:3], v).predict(X[:3])],
}
# anything that NumPy or a user may make of an array
ANYTHING = st.one_of(
    hnp.arrays(
        dtype=st.one_of(
            hnp.floating_dtypes(endianness="?"), hnp.integer_dtypes(endianness="?"), hnp.boolean_dtypes(),
            hnp.complex_number_dtypes(endianness="?"), hnp.unicode_string_dtypes(), hnp.datetime64_dtypes(),
            st.just(np.longdouble),
        ),
        shape=hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
    ),
    st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.complex_numbers(), st.text(max_size=2),
                  st.decimals(), st.fractions(), st.just(np.ma.masked), st.just(Missing())),
        lambda inner: st.one_of(st.lists(inner, max_size=3), st.lists(inner, max_size=3).map(tuple),
                                st.lists(inner, max_size=3).map(deque)),
        max_leaves=6,
    ),
    st.lists(st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0]), min_size=2, max_size=2), min_size=1, max_size=3),
    st.sampled_from([MATRIX, sparse.eye_array(2), torch.eye(2), torch.eye(2, requires_grad=True),
                     Frame(np.eye(2)), range(3), {0.5}, b"ab", np.eye(2)[::-1], np.eye(2, dtype=np.float16)]),
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:Warning. converting a masked element")
@pytest.mark.parametrize("entry", [*(name for name in ENTRIES if not name.startswith(INNER)), *TINY])
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(value=ANYTHING)
@example(value=[[1e308], [-1e308]])
@example(value=[0.0, 5e-324, 1.0])
@example(value=[[0.5, 0.5]])
@example(value=np.ma.array([0.5, 0.5], mask=[True, False]))
def test_whatever_comes_in_the_answer_is_a_number_or_a_typed_error(entry, value):
    call = TINY[entry] if entry in TINY else ENTRIES[entry][1]
    with suppress(ConformalError):
        for found in call(value):
            assert np.asarray(found).dtype.kind != "f" or not np.isnan(found).any()
