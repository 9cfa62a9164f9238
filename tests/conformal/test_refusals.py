"""What the conformal core refuses: one table of calls, each with the argument that the error must name."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.tree import DecisionTreeClassifier

import conformodal.conformal as cm
from conformodal.conformal.checks import as_alpha

RNG = np.random.default_rng(0)
N, K = 80, 8
BINS = cm.QuantileBins.from_edges([np.arange(K + 1) ** 2 / 8, np.arange(K + 1) / 4])
ONE = cm.QuantileBins.from_edges([np.arange(K + 1) / 8])
P = RNG.dirichlet(np.ones(K), (N, 2))
Y = RNG.uniform(0, 2, (N, 2))
X = RNG.uniform(-4, 4, (N, 3))
W = RNG.uniform(0.1, 4, N)
HELD = RNG.random(N) < 0.9
GROUPS = np.arange(N) % 3
SPLIT = cm.SplitConformal(BINS, 0.2).calibrate(P, Y)
REGIONS = SPLIT.predict(P)
MONDRIAN = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, GROUPS)
CONDITIONAL = cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, W)
NAMED = cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, pd.DataFrame({"a": W, "b": W}))
NOVELTY = cm.NoveltyTest(X, GROUPS)
MASKS = [np.ones((2, K), bool)] * 2
BOUNDED = np.zeros((2, 2), bool)
NAN = np.full(N, np.nan)


def tree(**options):
    inner = DecisionTreeClassifier(max_depth=3, random_state=0)
    return cm.ConformalRegressor(inner, **({"n_bins": 4, "alpha": 0.3, "random_state": 0} | options))


def split(p=P, y=Y, **settings):
    return cm.SplitConformal(BINS, **settings).calibrate(p, y)


def spoilt(values, with_value):
    values = values.copy()
    values.flat[-1] = with_value
    return values


FITTED = tree().fit(X, Y)
RATES = [np.float64(0.1), np.float32(0.1), np.float16(0.1), np.array(0.1), "0.1", "1/10", "1e-1", Decimal("0.1"),
         Fraction(1, 10)]  # fmt: skip
NOT_RATES = [True, [0.1], None, float("nan"), float("inf"), 0, 1.0, 10, -0.1, "1/0", "ten percent"]


def test_rates_are_read_as_the_decimal_they_are_written_as():
    for rate in RATES:
        assert as_alpha(rate) == Fraction(1, 10)


NOT_COUNTS = [True, 2.0, "3", None, -1, float("nan"), 3 * 10**9]
NOT_NUMBERS = [None, "0.1", float("nan"), True, -1.0, float("inf")]
PARAMETERS = {  # argument, values that it does not take, what takes it
    "alpha": ("alpha", NOT_RATES, lambda v: split(alpha=v)),
    "alpha of at": ("alpha", NOT_RATES, SPLIT.at),
    "alpha online": ("alpha", NOT_RATES, lambda v: cm.OnlineConformal(BINS, v)),
    "alpha of a band": ("alpha", NOT_RATES, lambda v: cm.coverage_band(9, 9, v)),
    "n_bins": ("n_bins", NOT_COUNTS, lambda v: cm.QuantileBins(v).fit(Y)),
    "n_bins of a regressor": ("n_bins", [v for v in NOT_COUNTS if v is not None], lambda v: tree(n_bins=v).fit(X, Y)),
    "n_test": ("n_test", NOT_COUNTS[:-1], lambda v: cm.coverage_band(9, v, 0.1)),
    "margin": ("margin", NOT_NUMBERS, lambda v: cm.QuantileBins(3, margin=v).fit(Y)),
    "sigma_bins": ("sigma_bins", NOT_NUMBERS, lambda v: BINS.soft_targets(Y, v)),
    "gamma": ("gamma", NOT_NUMBERS, lambda v: cm.Aci(gamma=v)),
    "level": ("level", NOT_NUMBERS, lambda v: cm.coverage_band(9, 9, 0.1, v)),
    "share": ("share", [v for v in NOT_NUMBERS if v is not None], lambda v: cm.Aps(share=v)),
    "calibration_size": ("calibration_size", NOT_NUMBERS, lambda v: tree(calibration_size=v).fit(X, Y)),
    "joint": ("joint", ["all", ["none"], None], lambda v: split(joint=v)),
    "empty": ("empty", ["drop", None], lambda v: split(empty=v)),
    "score": ("score", ["best", cm.Lac, None], lambda v: split(score=v)),
    "bins": ("bins", [[0, 1], None], lambda v: cm.SplitConformal(v).calibrate(P, Y)),
    "estimator": ("estimator", [5, "slow", DecisionTreeClassifier], lambda v: cm.ConformalRegressor(v).fit(X, Y)),
    "window": ("window", [2.5, 0], lambda v: cm.Aci(window=v)),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_values_that_a_parameter_does_not_take_are_refused(name):
    argument, values, call = PARAMETERS[name]
    for value in values:
        with pytest.raises(cm.ConformodalError, match=argument):
            call(value)


REFUSED = [
    ("edges", lambda: cm.QuantileBins.from_edges([[0, np.inf]])),
    ("edges", lambda: cm.QuantileBins.from_edges([[0.0, 0.0]])),
    ("edges", lambda: cm.QuantileBins.from_edges([])),
    ("edges", lambda: cm.QuantileBins.from_edges([[-1.7e308, 1.7e308]])),
    ("target 0", lambda: cm.QuantileBins(3, margin=1e308).fit([0.0, 100.0])),
    ("y", lambda: cm.QuantileBins(3).fit(np.empty((3, 0)))),
    ("y", lambda: cm.QuantileBins(5).fit([])),
    ("row 1", lambda: cm.QuantileBins(5).fit([1.0, np.nan])),
    ("y has", lambda: cm.QuantileBins(5).fit([1.0, 2.0]).encode(np.zeros((3, 2)))),
    (r"did you mean 0\.1", lambda: cm.conformal_rank(10, 90)),
    ("n must", lambda: cm.conformal_rank(-1, 0.1)),
    ("axis", lambda: cm.conformal_quantile([1.0], 0.1, axis=3)),
    ("sizes", lambda: cm.hierarchical_quantile([[1.0]], 0.1, [2.7])),
    ("unit 1", lambda: cm.hierarchical_quantile([[1.0], []], 0.1)),
    ("proba.*nan", lambda: split(spoilt(P, np.nan))),
    ("proba.*sum to 1", lambda: split(P * 2)),
    ("proba.*negative", lambda: split(P + np.eye(8)[0] - np.eye(8)[1])),
    ("proba", lambda: split(P[:, :1])),
    ("proba", lambda: split(P[:, :, :-1])),
    ("y has", lambda: split(P, Y[:-1])),
    ("y has", lambda: split(P, Y[:, :1])),
    ("y", lambda: split(P, spoilt(Y, np.inf))),
    ("scores", lambda: cm.SplitConformal(BINS).calibrate_scores(np.zeros(3))),
    ("fit_scale", lambda: split(joint="max")),
    ("thresholds", lambda: SPLIT.regions_at(P, [np.nan, 0.5])),
    ("conditions", lambda: cm.ConditionalConformal(BINS).calibrate(P, Y, W[:3])),
    ("conditions", lambda: CONDITIONAL.predict(P, np.ones((N, 2)))),
    ("80 rows", lambda: CONDITIONAL.predict(P, W[:2])),
    ("conditions", lambda: NAMED.predict(P, pd.DataFrame({"a": W, "c": W}))),
    ("conditions.*another order", lambda: NAMED.predict(P, pd.DataFrame({"b": W, "a": W}))),
    ("groups", lambda: cm.MondrianConformal(BINS).calibrate(P, Y, [1])),
    ("units", lambda: cm.SplitConformal(BINS).calibrate(P, Y, [1])),
    ("masks", lambda: cm.Regions(BINS, MASKS[:1], BOUNDED)),
    ("masks", lambda: cm.Regions(BINS, [MASKS[0], MASKS[0][:, :3]], BOUNDED)),
    ("unbounded", lambda: cm.Regions(BINS, MASKS, BOUNDED[:, :1])),
    ("y has", lambda: REGIONS.contains(Y[:2])),
    ("groups", lambda: cm.diagnose(MONDRIAN, P, Y)),
    ("inside", lambda: cm.diagnose(SPLIT, P[:0], Y[:0])),
    ("inside", lambda: cm.check_coverage([0.0, np.nan], 9, 0.1)),
    ("references", lambda: cm.NoveltyTest(np.zeros(3), [0, 1, 2])),
    ("units", lambda: cm.NoveltyTest([[0.0], [1.0]], [5, 5])),
    ("samples", lambda: NOVELTY.scores(np.zeros((1, 2)))),
    ("y_max", lambda: cm.QuantileBins(9, y_max=[1, 2, 3]).fit(Y)),
    ("y_min", lambda: cm.QuantileBins(9, y_min=3, y_max=3).fit(Y)),
    ("row 0", lambda: cm.QuantileBins(9, y_min=5).fit(Y)),
    ("row 0", lambda: tree(y_min=0).fit(X, Y).conformalize(X, -1 - Y)),
    ("order", lambda: cm.Aps("size")),
    ("regions", lambda: FITTED.predict_density(X).flat_probabilities(REGIONS[:3])),
    ("y", lambda: FITTED.predict_density(X).pdf([1.0])),
    ("levels", lambda: BINS.proba_from_quantiles([0.5, 0.1], np.zeros((2, 2)))),
    ("levels", lambda: BINS.proba_from_quantiles([0.1, 0.5], np.zeros((2, 3)))),
    ("values", lambda: BINS.proba_from_quantiles([0.1, 0.5], [[0, np.nan]])),
    ("samples", lambda: BINS.proba_from_samples([1.0, 2.0])),
    ("cdf", lambda: BINS.proba_from_cdf(lambda y: np.full(3, np.nan))),
    ("q must", lambda: FITTED.predict_density(X).quantile(1.5)),
    ("groups", lambda: FITTED.predict_region(X, groups=GROUPS)),
    ("groups", lambda: FITTED.predict(X, groups=GROUPS)),
    ("groups", lambda: tree().fit(X, Y, groups=GROUPS).predict_region(X)),
    ("groups", lambda: tree().fit(X, Y, groups=GROUPS[:3])),
    ("80 groups", lambda: tree().fit(X, Y, groups=np.arange(N))),
    ("alpha", lambda: FITTED.predict(X, alpha=0.02)),
    ("n_samples=2", lambda: tree().fit(X[:2], Y[:2])),
    ("estimator", lambda: FITTED.predict(X * 1e39)),
    ("sample_weight", lambda: tree().fit(X, Y, W[:5])),
    ("sample_weight", lambda: tree().fit(X, Y, -W)),
    ("sample_weight", lambda: tree().fit(X, Y, 0 * W)),
    ("y", lambda: cm.StackedDensity().fit_bins(X, W * 1e300, [0, 1])),
    ("y", lambda: cm.QuickDensity().fit_bins(X, W[:3], [0, 1])),
    ("X", lambda: cm.QuickDensity().fit_bins(X, W, [0, 1], np.eye(N)[0])),
]


@pytest.mark.parametrize(("argument", "call"), REFUSED)
@pytest.mark.filterwarnings("error", "ignore:rows unlike:UserWarning")
def test_the_argument_is_named(argument, call):
    with pytest.raises(cm.ConformodalError, match=argument):
        call()


def uncalibrated():
    return tree(calibration_size=0).fit(X, Y)


@pytest.mark.parametrize(
    "call",
    [
        lambda: cm.QuantileBins(5).encode([1.0]),
        lambda: cm.SplitConformal(BINS).predict(P),
        lambda: uncalibrated().predict_region(X),
        lambda: uncalibrated().diagnose(X, Y),
        lambda: cm.QuickDensity().predict_proba(X),
    ],
)
def test_what_is_not_calibrated_is_also_not_fitted(call):
    with pytest.raises(cm.NotCalibratedError) as error:
        call()
    assert isinstance(error.value, NotFittedError)


def test_a_tracker_learns_nothing_from_what_is_not_a_score():
    tracker = cm.Aci(0.1)
    tracker.update(0.5)
    for score in (np.nan, None, "1"):
        with pytest.raises(cm.ConformodalError, match="score"):
            tracker.update(score)
    assert len(tracker.past) == 1


class Odd:
    """A score whose values are replaced."""

    name = "odd"

    def __init__(self, give):
        self.give = give

    def of_bins(self, proba, widths):
        return self.give(1 - proba)


@pytest.mark.parametrize("give", [lambda s: s * np.nan, lambda s: s[:, :1], lambda s: s + 0j])
def test_custom_scores_are_checked(give):
    odd = cm.SplitConformal(BINS, 0.1, Odd(give))
    for call in (lambda: odd.regions_at(P, [0.5, 0.5]), lambda: odd.calibrate(P, Y)):
        with pytest.raises(cm.ConformodalError, match="score"):
            call()


def test_a_registered_score_is_known_by_its_name():
    cm.register_score(Odd(lambda s: s))
    expected = split(score="lac").thresholds_
    np.testing.assert_allclose(split(score="odd").thresholds_, expected, rtol=1e-11)
