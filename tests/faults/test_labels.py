"""Labels of groups and folds in every container: the same label is the same, and a missing one is a typed error."""

from collections import deque
from datetime import UTC, date, datetime, timedelta
from decimal import Decimal
from enum import StrEnum

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

import conformodal.conformal as cm
from conformodal.conformal.diagnostics.coverage import coverage_by_group
from conformodal.conformal.grouping import as_groups, as_label, factorise
from tests.helpers import Missing

N = 60
RNG = np.random.default_rng(0)
BINS = cm.QuantileBins.from_edges([np.arange(5) / 4])
P = RNG.dirichlet(np.ones(4), N)
Y = RNG.random(N)
CODES = np.arange(N) % 3
HELD = RNG.random(N) < 0.8


class Kind(StrEnum):
    A, B, C = "a", "b", "c"


def objects(values):
    found = np.empty(len(values), object)
    found[:] = values
    return found


def of(labels):
    return [labels[c] for c in CODES]


DAYS = [date(2020, 1, 1), date(2021, 1, 1), date(2022, 1, 1)]
TIMES = [datetime(d.year, d.month, d.day) for d in DAYS]
SPANS = [timedelta(seconds=s) for s in (1, 2, 3)]
# the same three labels, in containers of all kinds
SAME = {
    "text": [
        of("abc"), tuple(of("abc")), deque(of("abc")), np.array(of("abc")), np.array(of("abc"), ">U4"),
        objects(of("abc")), objects(of(list(map(np.str_, "abc")))), of(list(Kind)),
        np.ma.array(of("abc")), np.array(of("abc"))[::-1].copy()[::-1],
    ],
    "numbers": [
        of([1, 2, 3]), np.array(of([1, 2, 3])), np.array(of([1, 2, 3]), ">i2"), np.array(of([1.0, 2.0, 3.0])),
        np.array(of([1, 2, 3]), np.uint8), objects(of([1, 2, 3])),
        torch.tensor(of([1, 2, 3])), list(torch.tensor(of([1, 2, 3]))), of([Decimal(1), Decimal(2), Decimal(3)]),
        of([np.int8(1), np.float32(2), 3]), np.array(of([1, 2, 3]), np.longdouble),
    ],
    "flags": [
        of([True, False, True]), np.array(of([True, False, True])), of([1, 0, 1]), objects(of([True, False, True])),
    ],
    "dates": [
        of(DAYS), of(TIMES), np.array(of(DAYS), "M8[D]"), np.array(of(DAYS), "M8[ns]"), np.array(of(DAYS), ">M8[s]"),
        objects(of(DAYS)), np.array(of(DAYS), "M8[Y]"),
        list(np.array(of(DAYS), "M8[h]")),
    ],
    "spans": [of(SPANS), np.array(of(SPANS), "m8[s]"), objects(of(SPANS))],
    "tuples": [
        of([("a", 1), ("a", 2), ("b", 1)]), objects(of([("a", 1), ("a", 2), ("b", 1)])),
        np.array(of([("a", 1), ("a", 2), ("b", 1)]), [("x", "U1"), ("y", int)]),
        of([("a", np.int64(1)), (np.str_("a"), 2), ("b", 1.0)]),
    ],
    "mixed": [of(["a", 1, (2, "b")]), objects(of(["a", 1, (2, "b")]))],
    "bytes": [of([b"a", b"b", b"c"]), np.array(of([b"a", b"b", b"c"])), objects(of([b"a", b"b", b"c"]))],
    "zoned times": [of([t.replace(tzinfo=UTC) for t in TIMES]), objects(of([t.replace(tzinfo=UTC) for t in TIMES]))],
    "nanoseconds": [np.array(of([1, 2, 3]), "M8[ns]"), list(np.array(of([1, 2, 3]), "M8[ns]"))],
    "months": [np.array(of([1, 2, 3]), "m8[M]"), list(np.array(of([1, 2, 3]), "m8[M]"))],
    "zeros at the end": [of(["a", "a\0", "b"]), objects(of(["a", "a\0", "b"]))],
    "large numbers": [of([2**53, 2**53 + 1, 0.5]), objects(of([2**53, 2**53 + 1, 0.5]))],
    "larger numbers": [of([2**70, 2**70 + 1, -1]), objects(of([2**70, 2**70 + 1, -1]))],
    "a word and its number": [of(["1", 1, 2]), objects(of(["1", 1, 2]))],
    "words for missing": [of(["nan", "None", ""]), np.array(of(["nan", "None", ""]))],
    "sets": [of([frozenset("a"), frozenset("b"), frozenset("c")]), objects(of(list(map(frozenset, "abc"))))],
}  # fmt: skip
SAME["text"] += [
    pd.Series(of("abc")), pd.Series(of("abc"), dtype="string"), pd.Categorical(of("abc")),
    pd.Series(of("abc"), dtype="category"), pd.Index(of("abc")),
]  # fmt: skip
SAME["numbers"] += [pd.Series(of([1, 2, 3]), dtype="Int64"), pd.Categorical(of([1, 2, 3]))]
SAME["dates"] += [
    pd.Series(pd.to_datetime(of(DAYS))), pd.DatetimeIndex(of(DAYS)), [pd.Timestamp(d) for d in of(DAYS)],
]  # fmt: skip


def mondrian(groups, new):
    cal = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, groups)
    return [*cal.predict(P, new).masks, np.array(list(cal.sizes_.values()))]


def cross(folds, new):
    cal = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, folds)
    names = factorise(as_groups(new, N))[0]
    return cal.predict(dict.fromkeys(names, P)).masks


def grouped(groups, new):
    cal = cm.SplitConformal(BINS, 0.6).calibrate(P, Y, groups)
    again = cal.at(0.5)
    return [cal.thresholds_, again.thresholds_, cal.p_values(P, Y), np.array(cal.n_units)]


def novelty(groups, new):
    test = cm.NoveltyTest(P, groups)
    return [test.scores_, test.weights_, test.left_out_p_values()]


def strata(groups, new):
    return [np.array([c.n_covered for c in coverage_by_group(HELD, groups, 99, 0.1).values()])]


USES = {"mondrian": mondrian, "cross": cross, "split": grouped, "novelty": novelty, "strata": strata}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("kind", SAME)
def test_the_same_labels_are_the_same_groups(use, kind):
    first, *others = SAME[kind]
    expected = USES[use](first, first)
    if use != "cross" and kind != "flags":  # whose folds are asked for by name, and which are numbers already
        others = [*others, CODES]
    for labels in others:  # calibrated on one container, asked for in another
        pairs = ((first, labels), (labels, first)) if use in ("mondrian", "cross") and labels is not CODES else ()
        for pair in pairs or ((labels, labels),):
            for a, b in zip(expected, USES[use](*pair), strict=True):
                np.testing.assert_array_equal(a, b)


ABSENT = {
    "None": None, "NaN": float("nan"), "np.nan": np.float32("nan"), "NaT": np.datetime64("NaT"),
    "no span": np.timedelta64("NaT"), "NA": Missing(), "masked": np.ma.masked, "Decimal NaN": Decimal("NaN"),
    "Decimal sNaN": Decimal("sNaN"), "NaN in a tuple": ("a", float("nan")), "None in a tuple": ("a", (1, None)),
    "tensor NaN": torch.tensor(float("nan")), "complex NaN": complex("nan"),
}  # fmt: skip


AT = np.arange(N) == 7
MISSING_ARRAYS = {
    "floats": np.where(AT, np.nan, CODES),
    "big-endian floats": np.where(AT, np.nan, CODES).astype(">f4"),
    "dates": np.where(AT, np.datetime64("NaT"), np.array(of(DAYS), "M8[D]")),
    "spans": np.where(AT, np.timedelta64("NaT"), np.array(of(SPANS), "m8[s]")),
    "masked": np.ma.array(of("abc"), mask=AT),
    "complex": np.where(AT, np.nan, CODES + 1j),
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("kind", [*ABSENT, *MISSING_ARRAYS])
def test_missing_labels_are_refused_by_row(use, kind):
    labels = [ABSENT.get(kind) if at else c for at, c in zip(AT, of("abc"), strict=True)]
    for form in (list, tuple, objects) if kind in ABSENT else (lambda _: MISSING_ARRAYS[kind],):
        with pytest.raises(cm.ConformalError, match="row 7"):
            USES[use](form(labels), of("abc"))


NO_LABELS = {
    "lists": [[c] for c in of("abc")], "dicts": [{c: 1} for c in of("abc")], "arrays": [np.arange(2)] * N,
    "columns": CODES[:, None], "too few": CODES[:-1], "too many": [*CODES, 1], "word": "abc" * (N // 3), "number": 3,
    "None": None, "generator": (c for c in CODES), "dict": dict(enumerate(CODES)), "none at all": [],
}  # fmt: skip


@pytest.mark.parametrize("use", USES)
def test_what_is_not_a_label_per_sample_is_refused(use):
    for kind, labels in NO_LABELS.items():
        if (use, kind) != ("split", "None"):
            with pytest.raises(cm.ConformalError, match=r"groups|folds"):
                USES[use](labels, CODES)


@pytest.mark.parametrize("new", ["z", 5, ("a", 1), date(2020, 1, 1), b"a", 2.5, True])
def test_labels_never_seen_fall_back_as_documented(new):
    whole, pooled = (
        cm.MondrianConformal(BINS, 0.2, fallback=f).calibrate(P, Y, of("abc")) for f in ("whole", "pooled")
    )
    assert whole.predict(P, [new] * N).unbounded.all()
    expected = pooled.regions_at(P, pooled.pooled_).masks[0]
    np.testing.assert_array_equal(pooled.predict(P, [new] * N).masks[0], expected)


def test_labels_of_mixed_types_keep_their_names_in_reports():
    labels = of(["1", 1, ("1",)])
    assert list(coverage_by_group(HELD, labels, 99, 0.1)) == ["'1'", "1", "('1',)"]
    assert list(coverage_by_group(HELD, of("bca"), 99, 0.1)) == ["a", "b", "c"]
    cal = cm.SplitConformal(BINS, 0.2).calibrate(P, Y)
    assert "group b" in str(cm.diagnose(cal, P, Y, groups=pd.Series(of("abc"))))
    assert list(cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, labels).sizes_) == ["1", 1, ("1",)]


def test_folds_may_be_named_by_any_form_of_their_label():
    cal = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, of(DAYS))
    forms = [np.datetime64("2020-01-01"), datetime(2021, 1, 1), date(2022, 1, 1)]
    cal.predict(dict.fromkeys(forms, P))
    with pytest.raises(cm.ConformalError, match="missing"):
        cal.predict({None: P})
    with pytest.raises(cm.ConformalError, match="name the folds"):
        cal.predict({"2020-01-01": P})


def test_group_sizes_must_be_whole_and_one_a_group():
    scores = P[:, :1]
    whole = np.full(N, 30)
    assert cm.SplitConformal(BINS, 0.6).calibrate_scores(scores, of("abc"), whole).n_units == 3
    odd = np.where(np.arange(N) == 9, 40, whole)
    for sizes, says in ((odd, "row 9"), (whole + 0.5, "whole"), (whole[:3], "shape"), (whole // 30, "at least those")):
        with pytest.raises(cm.ConformalError, match=says):
            cm.SplitConformal(BINS, 0.6).calibrate_scores(scores, of("abc"), sizes)
    with pytest.raises(cm.ConformalError, match="need groups"):
        cm.SplitConformal(BINS, 0.6).calibrate_scores(scores, None, whole)


LABEL = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=2), st.binary(max_size=2),
              st.dates(), st.datetimes(), st.timedeltas(), st.decimals(), st.complex_numbers(),
              st.sampled_from([Missing(), np.datetime64("NaT"), np.datetime64(10**15, "Y"), np.timedelta64(1, "M")])),
    lambda inner: st.one_of(st.tuples(inner), st.tuples(inner, inner), st.lists(inner, max_size=2)),
    max_leaves=3,
)  # fmt: skip


@settings(max_examples=100, deadline=None, derandomize=True)
@given(labels=st.lists(LABEL, min_size=1, max_size=6))
@example(labels=["a", "a\0"])
@example(labels=[1, True, 1.0])
@example(labels=[2**53, 2.0**53, 2**53 + 1])
def test_whatever_labels_come_equal_ones_are_one_group(labels):
    try:
        keys, codes = factorise(as_groups(labels, len(labels)))
    except cm.ConformalError:
        return
    assert len(keys) == len(set(codes.tolist()))
    for label, code in zip(labels, codes, strict=True):
        assert keys[code] == as_label(label)
    assert len(set(keys)) == len(keys)
    shuffled, other = factorise(as_groups(objects(labels)[::-1], len(labels)))
    assert [shuffled[c] for c in other[::-1]] == [keys[c] for c in codes]
