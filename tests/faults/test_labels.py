"""Labels of groups, units and folds in every container: the same label is the same, a missing one is refused."""

from datetime import date, datetime
from enum import StrEnum

import numpy as np
import pandas as pd
import pytest

import conformodal.conformal as cm
from conformodal.conformal.checks import as_labels, factorise
from conformodal.conformal.diagnostics.coverage import coverage_by_group

N = 60
RNG = np.random.default_rng(0)
BINS = cm.QuantileBins.from_edges([np.arange(5) / 4])
P = RNG.dirichlet(np.ones(4), N)
Y = RNG.random(N)
CODES = np.arange(N) % 3
HELD = RNG.random(N) < 0.8


class Kind(StrEnum):
    A, B, C = "a", "b", "c"


def of(labels):
    return [labels[c] for c in CODES]


DAYS = [date(2020, 1, 1), date(2021, 1, 1), date(2022, 1, 1)]
TIMES = [datetime(d.year, d.month, d.day) for d in DAYS]
# the same three labels, in containers of all kinds
SAME = {
    "text": [
        of("abc"), tuple(of("abc")), np.array(of("abc")), np.array(of("abc"), object), of(list(Kind)),
        pd.Series(of("abc")), pd.Series(of("abc"), dtype="string"), pd.Categorical(of("abc")), pd.Index(of("abc")),
    ],
    "numbers": [
        of([1, 2, 3]), np.array(of([1, 2, 3])), np.array(of([1, 2, 3]), ">i2"), np.array(of([1.0, 2.0, 3.0])),
        np.array(of([1, 2, 3]), object), pd.Series(of([1, 2, 3]), dtype="Int64"), pd.Categorical(of([1, 2, 3])),
    ],
    "flags": [of([True, False, True]), np.array(of([True, False, True])), of([1, 0, 1])],
    "dates": [
        of(DAYS), of(TIMES), np.array(of(DAYS), "M8[D]"), np.array(of(DAYS), "M8[ns]"), np.array(of(DAYS), object),
        pd.Series(pd.to_datetime(of(DAYS))), [pd.Timestamp(d) for d in of(DAYS)],
    ],
}  # fmt: skip


def mondrian(groups, new):
    cal = cm.MondrianConformal(BINS, 0.2).calibrate(P, Y, groups)
    return [*cal.predict(P, new).masks, np.array(list(cal.sizes_.values()))]


def cross(folds, new):
    cal = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, folds)
    return cal.predict(dict.fromkeys(factorise(as_labels(new, N))[0], P)).masks


def split(units, new):
    cal = cm.SplitConformal(BINS, 0.6).calibrate(P, Y, units)
    return [cal.thresholds_, cal.at(0.5).thresholds_, cal.p_values(P, Y), np.array(cal.n_units)]


def novelty(units, new):
    test = cm.NoveltyTest(P, units)
    return [test.scores_, test.weights_, test.left_out_p_values()]


def strata(groups, new):
    return [np.array([c.n_covered for c in coverage_by_group(HELD, groups, 99, 0.1).values()])]


USES = {"mondrian": mondrian, "cross": cross, "split": split, "novelty": novelty, "strata": strata}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("kind", SAME)
def test_the_same_labels_are_the_same_groups(use, kind):
    first, *others = SAME[kind]
    expected = USES[use](first, first)
    for labels in others:  # calibrated on one container, asked for in another
        for pair in ((first, labels), (labels, first)):
            for a, b in zip(expected, USES[use](*pair), strict=True):
                np.testing.assert_array_equal(a, b)


AT = np.arange(N) == 7
REFUSED = {
    "None": np.where(AT, None, of("abc")).tolist(),
    "NaN": np.where(AT, np.nan, CODES),
    "NaN in text": [np.nan if at else c for at, c in zip(AT, of("abc"), strict=True)],
    "NaT": np.where(AT, np.datetime64("NaT"), np.array(of(DAYS), "M8[D]")),
    "NA": pd.Series(of([1, 2, 3]), dtype="Int64").mask(AT),
    "NA in text": pd.Series(of("abc"), dtype="string").mask(AT),
    "masked": np.ma.array(of("abc"), mask=AT),
    "of two kinds": of(["1", 1, 2]),
    "tuples": of([("a", 1), ("a", 2), ("b", 1)]),
    "lists": [[c] for c in of("abc")],
    "dicts": [{c: 1} for c in of("abc")],
    "columns": CODES[:, None],
    "too few": CODES[:-1],
    "word": "abc" * (N // 3),
    "number": 3,
    "generator": (c for c in CODES),
}


@pytest.mark.parametrize("use", USES)
def test_what_is_not_a_label_per_sample_is_refused(use):
    for kind, labels in REFUSED.items():
        with pytest.raises(cm.ConformodalError, match=r"groups|folds|units"):
            pytest.fail(f"{kind}: {USES[use](labels, CODES)}")


@pytest.mark.parametrize("new", ["z", 5, date(2020, 1, 1), 2.5])
def test_labels_never_seen_fall_back_as_documented(new):
    whole, pooled = (
        cm.MondrianConformal(BINS, 0.2, fallback=f).calibrate(P, Y, of("abc")) for f in ("whole", "pooled")
    )
    assert whole.predict(P, [new] * N).unbounded.all()
    expected = pooled.regions_at(P, pooled.pooled_).masks[0]
    np.testing.assert_array_equal(pooled.predict(P, [new] * N).masks[0], expected)


def test_folds_may_be_named_by_any_form_of_their_label():
    cal = cm.CrossConformal(BINS, 0.2).calibrate(P, Y, of(DAYS))
    forms = [np.datetime64("2020-01-01"), datetime(2021, 1, 1), date(2022, 1, 1)]
    assert len(cal.predict(dict.fromkeys(forms, P))) == N
    for folds in ({None: P}, {"2020-01-01": P}):
        with pytest.raises(cm.ConformodalError, match="folds"):
            cal.predict(folds)
