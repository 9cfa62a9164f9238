import warnings

import numpy as np
import pytest
from scipy.stats import norm

import conformodal.conformal as cm
from conformodal.conformal import ConditionalConformal, QuantileBins
from conformodal.conformal.calibrators import conditional

BINS = QuantileBins.from_edges([np.linspace(-30, 30, 601)])
FLAT = np.full((2000, 600), 1 / 600)


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
    its = ConditionalConformal(BINS, alpha, Size())
    its.scores_, its.conditions_, its.names_ = np.asarray(scores)[:, None], np.asarray(conditions, dtype=float), []
    return its.thresholds(asked)[:, 0]


@pytest.mark.parametrize("alpha", [0.1, 0.25, 0.05])
def test_constant_condition_gives_the_conformal_quantile(rng, alpha):
    for n in range(1, 60):
        for scores in (plain := rng.normal(size=n), np.round(plain)):
            found = thresholds(scores, np.ones((n, 1)), np.ones((1, 1)), alpha)
            np.testing.assert_allclose(found, cm.conformal_quantile(scores, alpha), atol=1e-8)


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


def test_unseen_condition_gives_an_unbounded_region(rng):
    y = rng.normal(size=100)
    its = ConditionalConformal(BINS).calibrate(FLAT[:100], y, np.zeros((100, 1)))
    with pytest.warns(UserWarning, match="regions of 1 of 2 samples are unbounded: too few calibration samples"):
        assert its.predict(FLAT[:2], [[0], [1]]).unbounded[:, 0].tolist() == [False, True]


def test_values_beyond_the_bins_count_as_worse_than_all_others(rng):
    y = rng.normal(size=40)
    for beyond in (3, 5):  # of 40: ceil(41 * 0.9) = 37 scores reach the threshold
        y[:beyond] = 99
        its = ConditionalConformal(BINS, score=Size()).calibrate(FLAT[:40], y, np.zeros(40))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore" if beyond > 3 else "error")
            assert its.predict(FLAT[:1], [0]).unbounded[0, 0] == (beyond > 3)


@pytest.mark.filterwarnings("ignore:regions of")
def test_infinite_scores_do_not_weaken_a_shift(rng):
    """One in ten scores is infinite, more of them at one end, where regions must be unbounded often enough."""
    n, held, at = 60, [], np.linspace(0.05, 0.95, 10)
    for _ in range(150):
        x = rng.random(n)
        scores = np.where(rng.random(n) < 0.2 * x, np.inf, np.abs(rng.normal(size=n)))
        found = thresholds(scores, x[:, None], at[:, None])
        held.append(np.where(np.isinf(found), 1, (2 * norm.cdf(found) - 1) * (1 - 0.2 * at)))
    covered = np.array(held) @ at / at.sum()
    assert 0.9 - 4 * covered.std() / np.sqrt(len(covered)) <= covered.mean()


@pytest.mark.parametrize(("offset", "factor"), [(2e9, 1), (0, 1e12), (-3, 1e-6)])
def test_conditions_on_any_scale_give_the_same_thresholds(rng, offset, factor):
    x, scores, asked = rng.random((60, 2)), np.abs(rng.normal(size=60)), rng.random((5, 2))
    plain = thresholds(scores, x, asked)
    np.testing.assert_allclose(thresholds(scores, offset + factor * x, offset + factor * asked), plain, rtol=1e-4)
    doubled, twice = np.hstack((x, x @ [[1.0], [2.0]])), np.hstack((asked, asked @ [[1.0], [2.0]]))
    np.testing.assert_allclose(thresholds(scores, doubled, twice), plain, rtol=1e-6)  # a column that adds nothing


@pytest.mark.parametrize("ratio", [1e-7, 1e-4, 1e4, 1e7])
def test_groups_with_scores_of_other_sizes_keep_their_thresholds(rng, ratio):
    scores, group = np.abs(rng.normal(size=80)) * 1e-3, np.repeat([0, 1], 40)
    scores[group == 1] *= ratio if ratio < 1 else 1
    scores[group == 0] /= ratio if ratio > 1 else 1
    found = thresholds(scores, group[:, None] == [0, 1], np.eye(2))
    over = found / [cm.conformal_quantile(scores[group == g], 0.1) for g in (0, 1)]
    assert ((over >= 1) & (over <= 1 + 1e-3)).all()


@pytest.mark.parametrize("ratio", [1, 1e7, 1e12, 1e300])
def test_atoms_of_far_larger_scores_are_not_lost_to_rounding(rng, ratio):
    scores, group = np.ceil(3 * np.abs(rng.normal(size=200))), rng.integers(0, 2, 200)
    scores[group == 1] *= ratio
    values = np.array([0, 1, 4, 9, 25, 64, 1e15, 1e16])
    for given in (scores, rng.choice(values, 200, p=[0.2, 0.15, 0.1, 0.09, 0.07, 0.07, 0.25, 0.07])):
        calibration, asked, _ = conditional._coordinates((group[:, None] == [0, 1]) * 1.0, np.eye(2))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            limits = conditional._limits(given, calibration, asked, 0.1)
        quantiles = [cm.conformal_quantile(given[group == g], 0.1) for g in (0, 1)]
        assert (limits >= quantiles).all()
        same = [np.sum(given[group == g] <= limits[g]) == np.sum(given[group == g] <= quantiles[g]) for g in (0, 1)]
        assert all(same) != any("scale them" in str(warning.message) for warning in told)
