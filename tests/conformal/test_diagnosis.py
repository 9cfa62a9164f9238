from dataclasses import replace

import numpy as np
import pytest

from conformodal.conformal import ConformalRegressor, DataWarning, QuantileBins, Regions, SplitConformal, diagnose
from conformodal.conformal.diagnosis import summarise_sizes


def test_sizes():
    bins = QuantileBins.from_edges([[0.0, 1, 3, 6]])
    masks = [np.array([[1, 0, 1], [0, 0, 0], [0, 1, 0], [1, 1, 1]], bool)]
    found = summarise_sizes(Regions(bins, masks, np.array([[0], [0], [0], [1]], bool)))[0]
    assert (found.mean, found.median, found.q90) == (2, 2, np.inf)  # the mean is that of the bounded sets
    assert (found.intervals, found.split, found.empty, found.unbounded) == (1.0, 0.25, 0.25, 0.25)


def problem(joint):
    rng = np.random.default_rng(3)
    bins = QuantileBins.from_edges([np.linspace(0, 1, 21)] * 2)
    proba, y = rng.dirichlet(np.ones(20), (900, 2)), rng.random((900, 2))
    bins.names = ["left", "right"]
    cal = SplitConformal(bins, 0.1, "density", joint).fit_scale(proba[:100], y[:100])
    return cal.calibrate(proba[100:500], y[100:500]), proba[500:], y[500:]


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_a_diagnosis_says_everything_in_one_call(joint):
    cal, proba, y = problem(joint)
    found = diagnose(cal, proba, y, groups=np.arange(400) % 2)
    inside = cal.predict(proba).contains(y)
    expected = [inside.all(axis=1).mean()] if joint == "max" else inside.mean(axis=0)
    assert [c.coverage.coverage for c in found.columns] == pytest.approx(expected)
    assert found.joint_coverage == inside.all(axis=1).mean()
    assert all(column.coverage.inside for column in found.columns)
    first = inside.all(axis=1) if joint == "max" else inside[:, 0]
    assert found.columns[0].parts["group 1"].coverage == first[1::2].mean()
    text = str(found)
    for word in ("alpha = 0.1", "left", "group 1", "exchangeable", f"joint {joint}"):
        assert word in text
    assert ("guaranteed on average" in text) == (joint == "bonferroni")  # with max it is the coverage of all targets
    assert "] within" in text.replace("  ", " ")


def test_a_diagnosis_reports_a_broken_guarantee():
    cal, proba, y = problem("none")
    cal.thresholds_ = cal.thresholds_ - 1.5
    assert "BELOW" in str(diagnose(cal, proba, y))


def test_there_is_no_band_where_units_calibrate():
    """Rows of a unit are alike: the law of exchangeable rows would be violated in every other test."""
    rng = np.random.default_rng(0)
    bins = QuantileBins(20).fit(rng.normal(size=1000))
    proba = np.full((300, 20), 0.05)
    units = np.repeat(np.arange(30), 10)
    y = np.repeat(rng.normal(size=30), 10)
    cal = SplitConformal(bins, 0.1, "density").calibrate(proba, y, units)
    found = diagnose(cal, proba[:100], np.repeat(rng.normal(size=10), 10), np.arange(100) % 2)
    text = str(found)
    assert "300 calibration (of 30 units) and 100 test samples" in text
    assert "band  " not in text
    assert "there is no exact band" in " ".join(text.split())
    assert all(check.inside for _, check in found.columns[0].rows())


def test_rows_of_a_kind_never_learnt_are_checked_as_predicted():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(700, 2))
    y = X[:, 0] + 3 * X[:, 1] + rng.normal(0, 0.1, 700)
    reg = ConformalRegressor("quick", random_state=0).fit(X[:500], y[:500])
    new = X[500:].copy()
    new[:80, 1] = np.nan  # no value was missing in training
    with pytest.warns(DataWarning, match="unlike those of fit"):
        found, regions = reg.diagnose(new, y[500:]), reg.predict_region(new)
    assert found.sizes[0].unbounded == regions.unbounded.mean() == 0.4
    assert found.columns[0].coverage.coverage == regions.contains(y[500:]).mean()


def test_group_bands_hold_simultaneously():
    """Of many groups, the ten with the lowest coverage are shown."""
    bins, outside = QuantileBins.from_edges([np.linspace(0, 1, 21)]), 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        proba, y = rng.dirichlet(np.ones(20), 1100), rng.random(1100)
        cal = SplitConformal(bins, 0.1, "density").calibrate(proba[:400], y[:400])
        result = diagnose(cal, proba[400:], y[400:], np.arange(700) % 70)
        outside += not all(check.inside for check in (result.columns[0].coverage, *result.columns[0].parts.values()))
    assert outside <= 5  # of 100, each outside with probability 0.01
    assert len(result.columns[0].rows()) == 11
    assert "60 others: 60 within" in str(result)
    lowest, column = result.columns[0].rows()[1][0], result.columns[0]
    unbounded = replace(column.parts[lowest], n_covered=10, low=1.0, high=1.0)
    assert lowest not in dict(replace(column, parts={**column.parts, lowest: unbounded}).rows())
    assert "All 71 bands hold at once with probability 99 %" in str(result)
