import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformodal.conformal import QuantileBins, Regions, SplitConformal, diagnose
from conformodal.conformal.diagnostics.coverage import coverage_by_group, coverage_by_size
from conformodal.conformal.diagnostics.diagnosis import summarise_sizes
from conformodal.conformal.diagnostics.slab import lowest_run, worst_slab


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
    found = worst_slab(inside, X, 2000, 0.1)
    assert found.coverage < 0.75
    assert not found.inside
    fair = worst_slab(rng.random(4000) < 0.9, X, 2000, 0.1)
    assert fair.inside  # though the lowest on the half that chose it lies far below
    assert worst_slab(inside, np.zeros((4000, 1)), 2000, 0.1).n_test == 2000  # a constant input has one slab


def test_strata():
    inside = np.array([True] * 90 + [False] * 10)
    by = coverage_by_group(inside, ["a"] * 50 + ["b"] * 50, 99, 0.1)
    assert by["a"].coverage == 1
    assert by["b"].coverage == 0.8
    sizes = np.repeat([1.0, 2.0], 50)
    assert [c.n_test for c in coverage_by_size(inside, sizes, 99, 0.1).values()] == [50, 50]
    assert sum(c.n_test for c in coverage_by_size(inside, np.arange(100.0), 99, 0.1, strata=7).values()) == 100
    assert len(coverage_by_size(inside, np.full(100, np.inf), 99, 0.1)) == 1
    almost = np.where(np.arange(100) % 2, 0.3, 0.1 + 0.2)  # one length, summed in another order
    assert len(coverage_by_size(inside, almost, 99, 0.1)) == 1


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
    cal = SplitConformal(bins, 0.1, "density", joint).fit_scale(proba[:100], y[:100])
    return cal.calibrate(proba[100:500], y[100:500]), proba[500:], y[500:], rng.random((400, 2))


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_a_diagnosis_says_everything_in_one_call(joint):
    cal, proba, y, X = problem(joint)
    found = diagnose(cal, proba, y, X, groups=np.arange(400) % 2, names=["left", "right"])
    inside = cal.predict(proba).contains(y)
    expected = [inside.all(axis=1).mean()] if joint == "max" else inside.mean(axis=0)
    assert [c.coverage.coverage for c in found.columns] == pytest.approx(expected)
    assert found.joint_coverage == inside.all(axis=1).mean()
    assert all(column.coverage.inside and len(column.by_group) == 2 for column in found.columns)
    text = str(found)
    for word in ("alpha = 0.1", "left", "worst slab", "group 1", "exchangeable", f"joint {joint}"):
        assert word in text
    assert ("guaranteed on average" in text) == (joint == "bonferroni")  # with max it is the coverage of all targets
    assert "] within" in text.replace("  ", " ")


def test_a_diagnosis_reports_a_broken_guarantee():
    cal, proba, y, _ = problem("none")
    cal.thresholds_ = cal.thresholds_ - 1.5
    assert "BELOW" in str(diagnose(cal, proba, y))
