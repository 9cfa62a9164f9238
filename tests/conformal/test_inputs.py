"""Arrays and labels of unusual type at the entries of the package: the same answer as plain ones, or a typed error.

Tables: every entry (a function of one argument) x every disguise of good values, and x every kind of bad ones. Numbers
are multiples of powers of two, so that all floating types hold them exactly.
"""

from datetime import date, datetime

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import sparse
from sklearn.tree import DecisionTreeClassifier

import conformodal.conformal as cm
from conformodal.conformal.checks import as_probabilities, as_reals
from tests.helpers import Missing

RNG = np.random.default_rng(0)
N, D, K = 60, 2, 8
BINS = cm.QuantileBins.from_edges([np.arange(K + 1) ** 2 / 8, np.arange(K + 1) / 4])
P = RNG.multinomial(64, RNG.dirichlet(np.ones(K), (N, D))) / 64
Y = RNG.integers(0, 32, (N, D)) / np.array([4, 16])
G = np.arange(N) % 3
X = RNG.integers(-32, 32, (N, 3)) / 8
W = RNG.integers(1, 32, N) / 8


def parts(regions):
    return [*map(np.asarray, regions.masks), regions.unbounded]


def tree():
    inner = DecisionTreeClassifier(max_depth=3, random_state=0)
    return cm.ConformalRegressor(inner, n_bins=4, alpha=0.3, random_state=0)


FITTED = tree().fit(X, Y[:, 0])
SPLIT, JOINT = cm.SplitConformal(BINS, 0.2, "density"), cm.SplitConformal(BINS, 0.2, "hpd", "max", "mode")
for CALIBRATOR in (SPLIT, JOINT):
    CALIBRATOR.calibrate(P, Y)
NOVELTY = cm.NoveltyTest(X, G)
MONDRIAN = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, G)
ONLINE = cm.OnlineConformal(BINS, 0.2).update(P, Y)

# one argument of a public function: good values for it, and what the function makes of them
ENTRIES = {
    "predict": (P, lambda p: parts(SPLIT.predict(p))),
    "predict, joint": (P, lambda p: parts(JOINT.predict(p))),
    "calibrate proba": (P, lambda p: [cm.SplitConformal(BINS, 0.2, "aps").calibrate(p, Y).thresholds_]),
    "calibrate y": (Y, lambda y: [cm.SplitConformal(BINS, 0.2).calibrate(P, y).thresholds_]),
    "calibrate_scores": (P[:, :, 0], lambda s: [cm.SplitConformal(BINS, 0.2).calibrate_scores(s).thresholds_]),
    "fit_scale": (P, lambda p: [cm.SplitConformal(BINS, 0.2, joint="max").fit_scale(p, Y).scale_]),
    "regions_at": (Y[0] / 8, lambda t: parts(SPLIT.regions_at(P, t))),
    "mondrian predict": (P, lambda p: parts(MONDRIAN.predict(p, G))),
    "conditions": (W, lambda w: [cm.ConditionalConformal(BINS, 0.2).calibrate(P, Y, w).thresholds([1.0])]),
    "online run": (P, lambda p: parts(cm.OnlineConformal(BINS, 0.2).run(p, Y))),
    "bins fit": (Y, lambda y: cm.QuantileBins(4).fit(y).edges_),
    "bins edges": (np.arange(9) / 8, lambda e: cm.QuantileBins.from_edges([e]).edges_),
    "bins soft targets": (Y, lambda y: BINS.soft_targets(y, 1.5)),
    "contains": (Y, lambda y: [SPLIT.predict(P).contains(y)]),
    "conformal_quantile": (W, lambda s: [cm.conformal_quantile(s, 0.2)]),
    "hierarchical_quantile": (W, lambda s: [cm.hierarchical_quantile([s, W], 0.4)]),
    "novelty references": (X, lambda x: [cm.NoveltyTest(x, G).scores_]),
    "novelty scores": (X, lambda x: [NOVELTY.scores(x)]),
    "regressor X": (X, lambda x: [tree().fit(x, Y).predict(X)]),
    "regressor y": (Y, lambda y: [tree().fit(X, y).predict(X)]),
    "regressor predict": (X, lambda x: [FITTED.predict(x), *parts(FITTED.predict_region(x))]),
}


def replaced(value, dtype=object):
    def put(a):
        other = a.astype(dtype)
        other.flat[-1] = value
        return other

    return put


DISGUISES = {
    "big-endian": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
    "lists": lambda a: a.tolist(),
    "objects": lambda a: a.astype(object),
    "tensor": torch.from_numpy,
}
SHORT = {"half": lambda a: a.astype(np.float16), "short tensor": lambda a: torch.from_numpy(a.astype(np.float32))}


@pytest.mark.parametrize("entry", ENTRIES)
def test_the_same_numbers_give_the_same_answer(entry):
    good, call = ENTRIES[entry]
    for plain, disguises in ((good, DISGUISES), (good.astype(np.float32), SHORT)):
        expected = call(plain)
        for disguise, put_on in disguises.items():
            for a, b in zip(expected, call(put_on(good)), strict=True):
                np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=disguise)
                assert np.asarray(a).dtype == np.asarray(b).dtype, disguise


BAD = {
    "complex": lambda a: a + 1j, "text": lambda a: a.astype(str), "dates": lambda a: (a * 64).astype("M8[D]"),
    "masked": lambda a: np.ma.masked_equal(a, a.flat[-1]), "None": replaced(None), "NA": replaced(Missing()),
    "integer too large": replaced(10**400), "NaN": replaced(np.nan, float), "number": lambda a: 0.5,
    "ragged": lambda a: [*a.tolist(), [0.5, [0.5]]], "dict": lambda a: dict(enumerate(a.tolist())),
    "an axis too many": lambda a: a[None, None, None], "sparse": lambda a: sparse.csr_array(a.reshape(len(a), -1)),
}  # fmt: skip
ALLOWED = {  # what works along an axis, and what a tree can learn from
    "conformal_quantile": ("an axis too many",),
    **dict.fromkeys(("regressor X", "regressor predict"), ("NaN", "None", "sparse")),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_what_is_not_an_array_of_real_numbers_is_refused(entry):
    good, call = ENTRIES[entry]
    for damage in BAD.keys() - set(ALLOWED.get(entry, ())):
        with pytest.raises(cm.ConformodalError) as refusal:
            call(BAD[damage](good))
        assert 0 < len(str(refusal.value).splitlines()[0]) < 400, damage


# nested lists whose first two sizes agree: what NumPy makes of them, samples first
@pytest.mark.parametrize(("calibrator", "extra"), [(SPLIT, ()), (ONLINE, ()), (MONDRIAN, ([0, 1],))])
def test_lists_of_as_many_samples_as_targets_are_samples_first(calibrator, extra):
    rows = P[:D]
    expected = parts(calibrator.predict(rows, *extra))
    for nested in (rows.tolist(), [rows[:, 0], rows[:, 1]]):  # arrays in a list are one per target
        for a, b in zip(expected, parts(calibrator.predict(nested, *extra)), strict=True):
            np.testing.assert_array_equal(a, b)


def test_plain_arrays_are_not_copied():
    for dtype in (np.float32, np.float64):
        proba = P.astype(dtype)
        assert as_reals(proba, "proba") is proba
        assert all(np.shares_memory(part, proba) for part in as_probabilities(proba, BINS.sizes))


def of(labels):
    return [labels[c] for c in G]


DAYS = [date(2020, 1, 1), date(2021, 1, 1), date(2022, 1, 1)]
# the same three labels, in containers of all kinds
SAME_LABELS = {
    "text": [
        of("abc"), np.array(of("abc"), object), pd.Series(of("abc"), dtype="string"), pd.Categorical(of("abc")),
    ],
    "numbers": [
        of([1, 2, 3]), np.array(of([1, 2, 3]), ">i2"), np.array(of([1.0, 2.0, 3.0])), np.array(of([1, 2, 3]), object),
        pd.Series(of([1, 2, 3]), dtype="Int64"),
    ],
    "flags": [of([True, False, True]), np.array(of([True, False, True])), of([1, 0, 1])],
    "dates": [
        of(DAYS), [datetime(d.year, d.month, d.day) for d in of(DAYS)], np.array(of(DAYS), "M8[D]"),
        pd.Series(pd.to_datetime(of(DAYS))),
    ],
}  # fmt: skip


USES = {  # of labels to calibrate by, and to ask for
    "mondrian": lambda old, new: cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, old).predict(P, new).masks,
    "split": lambda old, new: [cm.SplitConformal(BINS, 0.6).calibrate(P, Y, old).at(0.5).thresholds_],
    "novelty": lambda old, new: [cm.NoveltyTest(X, old).left_out_p_values()],
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("kind", SAME_LABELS)
def test_the_same_labels_are_the_same_groups(use, kind):
    first, *others = SAME_LABELS[kind]
    expected = USES[use](first, first)
    for labels in others:  # calibrated on one container, asked for in another
        for pair in ((first, labels), (labels, first)):
            for a, b in zip(expected, USES[use](*pair), strict=True):
                np.testing.assert_array_equal(a, b)


AT = np.arange(N) == 7
BAD_LABELS = {
    "None": np.where(AT, None, of("abc")).tolist(), "NaN": np.where(AT, np.nan, G),
    "NaT": np.where(AT, np.datetime64("NaT"), np.array(of(DAYS), "M8[D]")),
    "NA": pd.Series(of("abc"), dtype="string").mask(AT), "masked": np.ma.array(of("abc"), mask=AT),
    "of two kinds": of(["1", 1, 2]), "lists": [[c] for c in of("abc")], "columns": G[:, None], "too few": G[:-1],
}  # fmt: skip


@pytest.mark.parametrize("use", USES)
def test_what_is_not_a_label_per_sample_is_refused(use):
    for kind, labels in BAD_LABELS.items():
        with pytest.raises(cm.ConformodalError, match=r"groups|units"):
            pytest.fail(f"{kind}: {USES[use](labels, G)}")
