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
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import sparse
from sklearn.tree import DecisionTreeClassifier

import conformodal.conformal as cm
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.diagnostics.coverage import coverage_by_size
from conformodal.conformal.diagnostics.slab import worst_slab
from conformodal.conformal.diagnostics.uniformity import check_uniformity
from conformodal.conformal.scores import SCORES
from tests.helpers import Missing

RNG = np.random.default_rng(0)
N, D, K = 80, 2, 8
BINS = cm.QuantileBins.from_edges([np.arange(K + 1) ** 2 / 8, np.arange(K + 1) / 4])
ONE = cm.QuantileBins.from_edges([np.arange(K + 1) / 8])
P = RNG.multinomial(64, RNG.dirichlet(np.ones(K), (N, D))) / 64
Y = RNG.integers(0, 32, (N, D)) / np.array([4, 16])
G = RNG.integers(0, 3, N)
X = RNG.integers(-32, 32, (N, 3)) / 8
W = RNG.integers(1, 32, N) / 8
HELD = RNG.random(N) < 0.9


def seen(regions):
    return [*map(np.asarray, regions.masks), regions.unbounded]


def split(score="density", joint="none", **kwargs):
    cal = cm.SplitConformal(BINS, 0.2, score, joint, **kwargs)
    if joint == "max":
        cal.fit_scale(P[:40], Y[:40])
    return cal.calibrate(P, Y)


def tree():
    return cm.ConformalRegressor(
        DecisionTreeClassifier(max_depth=3, random_state=0), n_bins=4, alpha=0.3, random_state=0
    )


FITTED = tree().fit(X, Y[:, 0])
SPLIT = {score: split(score) for score in SCORES}
JOINT, FULL = split(joint="max"), split(empty="mode")
NOVELTY = cm.NoveltyTest(X, G)
MONDRIAN = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, G)
WEIGHTED = cm.WeightedConformal(BINS, 0.2).calibrate(P, Y, W)
CROSS = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, G)
REGIONS = SPLIT["lac"].predict(P)
ONLINE = cm.OnlineConformal(BINS, 0.2)
ONLINE.update(P, Y)

# one argument of a public function: good values for it, and what the function makes of them
ENTRIES = {
    **{f"predict {score}": (P, lambda p, cal=cal: seen(cal.predict(p))) for score, cal in SPLIT.items()},
    "predict, few rows": (P[:3], lambda p: seen(SPLIT["lac"].predict(p))),
    "predict, joint max": (P, lambda p, cal=JOINT: seen(cal.predict(p))),
    "predict, empty mode": (P, lambda p, cal=FULL: seen(cal.predict(p))),
    "predict, one target": (P[:, 0], lambda p: seen(cm.SplitConformal(ONE).calibrate(P[:, 0], Y[:, 0]).predict(p))),
    "predict, a list": (P[:, 0], lambda p: seen(SPLIT["density"].predict([p, P[:, 1]]))),
    "calibrate proba": (P, lambda p: [cm.SplitConformal(BINS, 0.2).calibrate(p, Y).thresholds_]),
    "calibrate y": (Y, lambda y: [cm.SplitConformal(BINS, 0.2).calibrate(P, y).thresholds_]),
    "calibrate_scores": (P[:, :, 0], lambda s: [cm.SplitConformal(BINS, 0.2).calibrate_scores(s).thresholds_]),
    "fit_scale": (P, lambda p: [cm.SplitConformal(BINS, 0.2, joint="max").fit_scale(p, Y).scale_]),
    "p_values": (P, lambda p: [SPLIT["lac"].p_values(p, Y)]),
    "regions_at": (Y[0] / 8, lambda t: seen(SPLIT["lac"].regions_at(P, t))),
    "mondrian calibrate": (P, lambda p: list(cm.MondrianConformal(BINS, 0.2).calibrate(p, Y, G).thresholds_.values())),
    "mondrian predict": (P, lambda p: seen(MONDRIAN.predict(p, G))),
    "weights": (W, lambda w: [cm.WeightedConformal(BINS, 0.2).calibrate(P, Y, w).thresholds([1.0])]),
    "new weights": (W, lambda w: seen(WEIGHTED.predict(P, w))),
    "conditions": (W, lambda w: [cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, w).thresholds([1.0])]),
    "cross calibrate": (P, lambda p: list(cm.CrossConformal(BINS, 0.2).calibrate(p, Y, G).scores_.values())),
    "cross predict": (P, lambda p: seen(CROSS.predict({0: p, 1: P, 2: P}))),
    "online run": (P, lambda p: seen(cm.OnlineConformal(BINS, 0.2).run(p, Y))),
    "online y": (Y, lambda y: [cm.OnlineConformal(BINS, 0.2).update(P, y).thresholds]),
    "bins fit": (Y, lambda y: cm.QuantileBins(4).fit(y).edges_),
    "bins edges": (np.arange(9) / 8, lambda e: cm.QuantileBins.from_edges([e]).edges_),
    "bins encode": (Y, lambda y: [BINS.encode(y)]),
    "bins soft targets": (Y, lambda y: BINS.soft_targets(y, 1.5)),
    "contains": (Y, lambda y: [REGIONS.contains(y)]),
    "conformal_quantile": (W, lambda s: [cm.conformal_quantile(s, 0.2)]),
    "weighted_quantile scores": (W, lambda s: [cm.weighted_quantile(s, W, [1.0], 0.2)]),
    "weighted_quantile weights": (W, lambda w: [cm.weighted_quantile(W, w, w, 0.2)]),
    "hierarchical_quantile": (W, lambda s: [cm.hierarchical_quantile([s, W], 0.4)]),
    "hierarchical_maximum_quantile": (W, lambda s: [cm.hierarchical_maximum_quantile([s, W], 0.4)]),
    "novelty references": (X, lambda x: [cm.NoveltyTest(x, G).scores_]),
    "novelty scores": (X, lambda x: [NOVELTY.scores(x)]),
    "novelty p_values": (W, lambda s: [NOVELTY.p_values(s)]),
    "uniformity": (W, lambda s: [check_uniformity(s, W, 9).p_values]),
    "slab": (X, lambda x: [worst_slab(HELD, x, 99, 0.1, directions=5).direction]),
    "strata": (W, lambda s: list(coverage_by_size(HELD, s, 99, 0.1))),
    "diagnose": (Y[:9], lambda y: [str(cm.diagnose(SPLIT["lac"], P[:9], y))]),
    "regressor X": (X, lambda x: [tree().fit(x, Y).predict(X)]),
    "regressor y": (Y, lambda y: [tree().fit(X, y).predict(X)]),
    "regressor conformalize": (X, lambda x: [FITTED.conformalize(x, Y[:, 0]).calibrator_.thresholds_]),
    "regressor predict": (X, lambda x: [FITTED.predict(x), *seen(FITTED.predict_region(x))]),
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
    "strided": strided,
    "read-only": readonly,
    "subclass": lambda a: a.view(Units),
    "lists": lambda a: a.tolist(),
    "objects": lambda a: a.astype(object),
    "fractions": objects(Fraction),
    "decimals": objects(Decimal),
    "frame": Frame,
    "frame of objects": lambda a: Frame(a.astype(object)),
    "tensor": torch.from_numpy,
    "memory view": memoryview,
    "unpickled": lambda a: pickle.loads(pickle.dumps(a.astype(">f8"))),
}
SHORT = {  # of float32
    "big-endian 4": lambda a: a.astype(">f4"), "half": lambda a: a.astype(np.float16),
    "tensor 4": lambda a: torch.from_numpy(a.copy()),
}  # fmt: skip
# scikit-learn has its own rules for these
NOT_TABLES = {"memory view"}
DISGUISES = [(k, f, np.float64) for k, f in LONG.items()] + [(k, f, np.float32) for k, f in SHORT.items()]


@pytest.mark.parametrize("entry", ENTRIES)
def test_the_same_numbers_give_the_same_answer(entry):
    good, call = ENTRIES[entry]
    expected = {plain: call(good.astype(plain)) for plain in (np.float64, np.float32)}
    for disguise, put_on, plain in DISGUISES:
        if entry.startswith("regressor") and disguise in NOT_TABLES:
            continue
        for a, b in zip(expected[plain], call(put_on(good.astype(plain))), strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=disguise)
            assert np.asarray(a).dtype == np.asarray(b).dtype, disguise


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
    "complex": lambda a: a + 1j, "text": lambda a: a.astype(str), "dates": lambda a: (a * 64).astype("M8[D]"),
    "records": lambda a: np.zeros(a.shape, [("a", float)]), "masked": masked, "None": replaced(None),
    "NA": replaced(Missing()), "integer too large": replaced(10**400), "decimal sNaN": replaced(Decimal("sNaN")),
    "array among numbers": lambda a: replaced(a)(a), "NaN": with_float(np.nan),
    "ragged": lambda a: [*a.tolist(), [0.5, [0.5]]], "generator": lambda a: (row for row in a),
    "dict": lambda a: dict(enumerate(a.tolist())), "None alone": lambda a: None, "number": lambda a: 0.5,
    "0-d": lambda a: np.array(0.5), "empty list of lists": lambda a: [[], []],
    "an axis too many": lambda a: a[None, None, None], "sparse": lambda a: sparse.csr_array(a.reshape(len(a), -1)),
    "complex tensor": lambda a: torch.from_numpy(a + 0j),
    "sparse tensor": lambda a: torch.from_numpy(a.copy()).to_sparse(), "self-holding list": lambda a: ENDLESS,
}  # fmt: skip


@pytest.mark.parametrize("entry", ENTRIES)
def test_what_is_not_an_array_of_real_numbers_is_refused(entry):
    good, call = ENTRIES[entry]
    allowed = {  # what works along an axis, or element by element, and what a tree can learn from
        "novelty p_values": ("an axis too many", "NaN", "empty list of lists", "0-d", "number"),
        "conformal_quantile": ("an axis too many", "empty list of lists"),
        **dict.fromkeys(("regressor X", "regressor conformalize", "regressor predict"), ("NaN", "sparse")),
    }.get(entry, ())
    for damage in BAD.keys() - allowed:
        with pytest.raises(cm.ConformodalError) as told:
            call(BAD[damage](good))
        assert 0 < len(str(told.value).splitlines()[0]) < 400, damage


# nested lists whose first two sizes agree: what NumPy makes of them, samples first
@pytest.mark.parametrize(("cal", "extra"), [(SPLIT["lac"], ()), (ONLINE, ()), (MONDRIAN, ([0, 1],))])
def test_lists_of_as_many_samples_as_targets_are_samples_first(cal, extra):
    rows = P[:D]
    expected = seen(cal.predict(rows, *extra))
    for nested in (rows.tolist(), tuple(map(tuple, rows.tolist()))):
        for a, b in zip(expected, seen(cal.predict(nested, *extra)), strict=True):
            np.testing.assert_array_equal(a, b)
    # arrays in a list are one per target, as documented, and so are lists that can be nothing else
    np.testing.assert_array_equal(seen(cal.predict([rows[:, 0], rows[:, 1]], *extra))[0], expected[0])


NARROW = [1e-3, 1e-30, 1e-39, 1e-45, 1e-300, 1e-310, 5e-324]


@pytest.mark.parametrize("score", SCORES)
@pytest.mark.filterwarnings("error")
def test_narrow_bins_give_no_infinite_density(score):
    for dtype, width in product([np.float16, np.float32, np.float64], NARROW):
        bins = cm.QuantileBins.from_edges([[0, width, 2 * width, 1]])
        proba = np.tile(np.array([[0.5, 0, 0.5], [0, 0, 1]], dtype), (30, 1))
        y = np.tile([0.5 * width, 0.5], 30)
        cal = cm.SplitConformal(bins, 0.1, score).calibrate(proba, y)
        regions = cal.predict(proba)
        assert not np.isnan(cal.scores_).any()
        assert regions.contains(y).mean() >= 0.9
        assert not np.isnan(regions.length).any()


def test_plain_arrays_are_not_copied():
    cal = SPLIT["density"]
    from conformodal.conformal.checks import as_probabilities, as_reals

    for dtype in (np.float32, np.float64):
        proba = P.astype(dtype)
        assert as_reals(proba, "proba") is proba
        assert all(np.shares_memory(part, proba) for part in as_probabilities(proba, cal.bins.sizes))


with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    MATRIX = np.matrix([[0.5, 0.5]])
TWO = cm.QuantileBins.from_edges([[0, 1, 3]])
TWO_CAL = cm.SplitConformal(TWO, 0.3).calibrate(np.tile([0.75, 0.25], (9, 1)), np.tile([0.5, 0.5, 2.0], 3))
HALVES = np.full((3, 2), 0.5)


def calibrate_on(v):
    try:
        n = len(v)
    except TypeError:
        n = 0
    cal = cm.SplitConformal(TWO, 0.3, "density").calibrate(np.full((n, 2), 0.5), v)
    # of n calibration samples, at least k are in their own regions
    assert cal.predict(np.full((n, 2), 0.5)).contains(v).sum() >= min(cal.rank, n)
    return [cal.thresholds_]


# calls that take arrays so small that what comes by chance fits them
TINY = {
    "two bins": lambda v: [TWO_CAL.predict(v).length],
    "two bins, y": calibrate_on,
    "groups": lambda v: cm.MondrianConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).thresholds_.values(),
    "folds": lambda v: cm.CrossConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).scores_.values(),
    "units of split": lambda v: [cm.SplitConformal(TWO, 0.3).calibrate(HALVES, [0.5] * 3, v).n_units],
    "novelty of one number": lambda v: [cm.NoveltyTest([[0.0], [1.0]], [0, 1]).scores(v)],
    "three edges": lambda v: cm.QuantileBins.from_edges(v).widths,
    "units of scores": lambda v: [cm.hierarchical_quantile(v, 0.3)],
    "inside": lambda v: [cm.check_coverage(v, 9, 0.1).coverage],
    "index": lambda v: [REGIONS[v].unbounded],
    "alpha": lambda v: [float(as_alpha(v))],
    "score of a tracker": lambda v: [cm.Aci(0.1).update(v) is None],
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
    st.sampled_from([MATRIX, sparse.eye_array(2), torch.eye(2),
                     Frame(np.eye(2)), range(3), {0.5}, b"ab", np.eye(2)[::-1], np.eye(2, dtype=np.float16)]),
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:Warning. converting a masked element")
@pytest.mark.parametrize("entry", TINY)
@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(value=ANYTHING)
@example(value=[[1e308], [-1e308]])
@example(value=[0.0, 5e-324, 1.0])
@example(value=[[0.5, 0.5]])
@example(value=np.ma.array([0.5, 0.5], mask=[True, False]))
def test_whatever_comes_in_the_answer_is_a_number_or_a_typed_error(entry, value):
    with suppress(cm.ConformodalError):
        for found in TINY[entry](value):
            assert np.asarray(found).dtype.kind != "f" or not np.isnan(found).any()
