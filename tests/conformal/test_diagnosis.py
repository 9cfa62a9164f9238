import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformodal.conformal import QuantileBins, Regions, SplitConformal, check_coverage, diagnose
from conformodal.conformal.coverage import lowest_run, strata_of, worst_slab
from conformodal.conformal.diagnosis import summarise_sizes


@given(st.lists(st.booleans(), min_size=1, max_size=18), st.integers(1, 18))
def test_lowest_run_is_that_of_brute_force(values, least):
    v, least = np.array(values), min(least, len(values))
    best = min(v[i:j].mean() for i in range(v.size) for j in range(i + least, v.size + 1))
    start, stop = lowest_run(v, least)
    assert stop - start >= least
    assert v[start:stop].mean() == pytest.approx(best)


def test_a_slab_that_is_missed_is_found_and_checked_on_the_other_half():
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (4000, 3))
    bad = X @ [1, 1, 0] > 0.9
    inside = rng.random(4000) < np.where(bad, 0.5, 0.95)
    assert inside[worst_slab(inside, X)].mean() < 0.75
    fair = rng.random(4000) < 0.9
    rows = worst_slab(fair, X)
    assert check_coverage(fair[rows], 2000, 0.1).inside  # though the lowest on the half that chose it lies far below
    assert len(worst_slab(inside, np.zeros((4000, 1)))) == 2000  # a constant input has one slab


def test_strata():
    assert [rows.sum() for _, rows in strata_of(np.repeat([1.0, 2.0], 50))] == [50, 50]
    assert sum(rows.sum() for _, rows in strata_of(np.arange(103.0))) == 103
    assert len(strata_of(np.full(100, np.inf))) == 1
    assert len(strata_of(np.where(np.arange(100) % 2, 0.3, 0.1 + 0.2))) == 1  # one length, summed in another order


def test_sizes():
    bins = QuantileBins.from_edges([[0.0, 1, 3, 6]])
    masks = [np.array([[1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], bool)]
    found = summarise_sizes(Regions(bins, masks, np.array([[0], [0], [0], [1]], bool)))[0]
    assert (found.mean, found.median, found.q90) == (np.inf, 2, np.inf)
    assert (found.intervals, found.split, found.empty, found.unbounded) == (1.0, 0.25, 0.25, 0.25)


def problem(joint):
    rng = np.random.default_rng(3)
    bins = QuantileBins.from_edges([np.linspace(0, 1, 21)] * 2)
    proba, y = rng.dirichlet(np.ones(20), (900, 2)), rng.random((900, 2))
    bins.names = ["left", "right"]
    cal = SplitConformal(bins, 0.1, "density", joint).fit_scale(proba[:100], y[:100])
    return cal.calibrate(proba[100:500], y[100:500]), proba[500:], y[500:], rng.random((400, 2))


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_a_diagnosis_says_everything_in_one_call(joint):
    cal, proba, y, X = problem(joint)
    found = diagnose(cal, proba, y, X, groups=np.arange(400) % 2)
    inside = cal.predict(proba).contains(y)
    expected = [inside.all(axis=1).mean()] if joint == "max" else inside.mean(axis=0)
    assert [c.coverage.coverage for c in found.columns] == pytest.approx(expected)
    assert found.joint_coverage == inside.all(axis=1).mean()
    assert all(column.coverage.inside for column in found.columns)
    first = inside.all(axis=1) if joint == "max" else inside[:, 0]
    assert found.columns[0].parts["group 1"].coverage == first[1::2].mean()
    text = str(found)
    for word in ("alpha = 0.1", "left", "worst slab", "group 1", "exchangeable", f"joint {joint}"):
        assert word in text
    assert ("guaranteed on average" in text) == (joint == "bonferroni")  # with max it is the coverage of all targets
    assert "] within" in text.replace("  ", " ")


def test_a_diagnosis_reports_a_broken_guarantee():
    cal, proba, y, _ = problem("none")
    cal.thresholds_ = cal.thresholds_ - 1.5
    assert "BELOW" in str(diagnose(cal, proba, y))
