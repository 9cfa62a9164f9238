import numpy as np
import pytest
from scipy.stats import norm

import conformodal.conformal as cm
from conformodal.conformal import ConditionalConformal, QuantileBins

BINS = QuantileBins.from_edges([np.linspace(-6, 6, 241)])
FLAT = np.full((2000, 240), 1 / 240)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


class Size(cm.Score):
    """The absolute value at the bin's lower edge: the score of a value is known, whatever the probabilities."""

    name = "size"

    def of_bins(self, proba, widths):
        return np.broadcast_to(np.abs(BINS.edges_[0][:-1]), proba.shape)


def thresholds(scores, conditions, asked, alpha=0.1):
    """Thresholds of given scores, which need no bins."""
    its = ConditionalConformal(BINS, alpha)
    its.scores_, its.conditions_, its.names_ = np.asarray(scores)[:, None], np.asarray(conditions, dtype=float), []
    return its.thresholds(asked)[:, 0]


@pytest.mark.parametrize("alpha", [0.1, 0.25, 0.05])
def test_without_conditions_the_threshold_is_the_conformal_quantile(rng, alpha):
    for n in range(1, 60):
        scores = rng.normal(size=n)
        found = thresholds(scores, np.ones((n, 1)), np.ones((1, 1)), alpha)
        np.testing.assert_allclose(found, cm.conformal_quantile(scores, alpha), atol=1e-8)
        tied = np.round(scores)
        np.testing.assert_allclose(
            thresholds(tied, np.ones((n, 1)), np.ones((1, 1)), alpha), cm.conformal_quantile(tied, alpha), atol=1e-8
        )


def test_groups_that_do_not_overlap_have_thresholds_of_their_own(rng):
    scores, group = rng.normal(size=100), rng.integers(0, 4, 100)
    group[:5] = 9  # too few
    shown = np.array([0, 1, 2, 3, 9])
    found = thresholds(scores, group[:, None] == shown, np.eye(5))
    expected = [cm.conformal_quantile(scores[group == g], 0.1) for g in shown]
    assert np.isinf(expected[-1])
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_overlapping_groups_are_covered_each(rng):
    """The mean over calibrations of the exact coverage, in each of three groups that overlap."""
    kinds = np.array([[a, b, a * b] for a in (0, 1) for b in (0, 1)], dtype=float)
    share, spread, n, held = np.array([0.4, 0.2, 0.2, 0.2]), np.array([1, 2, 2, 5.0]), 80, []
    for _ in range(400):
        of = rng.choice(4, n, p=share)
        found = thresholds(np.abs(rng.normal(0, spread[of])), kinds[of], kinds)
        held.append(2 * norm.cdf(found / spread) - 1)
    for group in kinds.T > 0:
        weight = share[group] / share[group].sum()
        covered = np.array(held)[:, group] @ weight
        error = covered.std() / np.sqrt(len(covered))
        assert 0.9 - 4 * error <= covered.mean() <= 0.9 + 4 / ((n + 1) * share[group].sum()) + 4 * error


def test_shifts_along_a_smooth_condition_are_covered(rng):
    n, held, at = 60, [], np.linspace(0.05, 0.95, 10)[:, None]
    for _ in range(150):
        x = rng.random((n, 1))
        found = thresholds(np.abs(rng.normal(0, 0.2 + x[:, 0])), x, at)
        held.append(2 * norm.cdf(found / (0.2 + at[:, 0])) - 1)
    for weight in (at[:, 0], 1 - at[:, 0]):  # new samples drawn more often at one end
        covered = np.array(held) @ weight / weight.sum()
        error = covered.std() / np.sqrt(len(covered))
        assert 0.9 - 4 * error <= covered.mean() <= 0.9 + 2 / (n + 1) / weight.mean() + 4 * error


def test_regions_follow_the_conditions_of_each_row(rng):
    wide = rng.random(2000) < 0.5
    y = rng.normal(0, np.where(wide, 1.5, 0.5))
    its = ConditionalConformal(BINS, score=Size()).calibrate(FLAT[:1000], y[:1000], wide[:1000])
    regions = its.predict(FLAT[1000:], wide[1000:])
    for which in (wide[1000:], ~wide[1000:]):
        held = int(regions.contains(y[1000:])[which].sum())
        low, high = cm.coverage_band(int((wide[:1000] == which[0]).sum()), int(which.sum()), 0.1, 0.9999)
        assert low <= held / which.sum() <= high
    narrow = regions.length[~wide[1000:], 0]
    assert np.ptp(narrow) == 0
    assert narrow[0] < regions.length[wide[1000:], 0].min() / 2


def test_a_condition_that_calibration_never_met_leaves_the_region_unbounded(rng):
    y = rng.normal(size=100)
    its = ConditionalConformal(BINS).calibrate(FLAT[:100], y, np.zeros((100, 1)))
    assert its.predict(FLAT[:2], [[0], [1]]).unbounded[:, 0].tolist() == [False, True]


def test_values_beyond_the_bins_count_as_worse_than_all_others(rng):
    y = rng.normal(size=40)
    for beyond in (3, 5):  # of 40: ceil(41 * 0.9) = 37 scores reach the threshold
        y[:beyond] = 99
        its = ConditionalConformal(BINS, score="density").calibrate(FLAT[:40], y, np.zeros(40))
        assert its.predict(FLAT[:1], [0]).unbounded[0, 0] == (beyond > 3)


def test_joint_forms_have_a_threshold_for_each_target(rng):
    bins, y = QuantileBins(20).fit(rng.normal(size=(300, 2))), rng.normal(size=(300, 2))
    proba, group = [np.full((300, 20), 0.05)] * 2, rng.random((300, 2)) < 0.5
    for joint in ("none", "bonferroni", "max"):
        its = ConditionalConformal(bins, 0.2, "density", joint)
        if joint == "max":
            its.fit_scale([p[:100] for p in proba], y[:100])
        its.calibrate([p[100:] for p in proba], y[100:], group[100:])
        assert its.thresholds(group[:7]).shape == (7, 2)
