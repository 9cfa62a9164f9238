import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import (
    ConformalError,
    NotCalibratedError,
    QuantileBins,
    SplitConformal,
    check_coverage,
    conformal_rank,
    coverage_band,
)


def test_bonferroni_calibrates_each_target_at_its_exact_share(problem):
    bins, proba, y = problem(1, n=200, d=2)
    inside = np.clip(y, [e[0] for e in bins.edges_], [e[-1] for e in bins.edges_])
    joint = SplitConformal(bins, 0.1, joint="bonferroni").calibrate(proba, inside)
    single = SplitConformal(bins, 0.05).calibrate(proba, inside)
    np.testing.assert_array_equal(joint.thresholds_, single.thresholds_)
    assert joint.rank == conformal_rank(200, 0.05)


def test_short_calibration_gives_unbounded_regions(problem):
    bins, proba, y = problem(2)
    regions = SplitConformal(bins, 0.1).calibrate(proba[:8], y[:8]).predict(proba)
    assert regions.unbounded.all()
    assert regions.contains(y + 1e9).all()
    assert np.isinf(regions.length).all()
    assert np.isinf(regions.volume).all()
    assert regions.intervals(0)[0].tolist() == [[-np.inf, np.inf]]


def test_values_outside_the_edges_count_against_calibration(problem):
    bins, proba, _ = problem(3, n=20)
    far = np.full((20, 2), 1e6)
    cal = SplitConformal(bins, 0.5).calibrate(proba, far)
    assert np.isposinf(cal.scores_).all()
    assert cal.predict(proba).unbounded.all()


def test_lists_of_arrays_and_single_targets():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([[0, 1, 2], [0, 1, 2, 3]])
    parts = [rng.dirichlet(np.ones(k), size=30) for k in (2, 3)]
    y = rng.uniform(0, 2, (30, 2))
    assert SplitConformal(bins).calibrate(parts, y).predict(parts).contains(y).shape == (30, 2)
    one = QuantileBins.from_edges([[0, 1, 2]])
    assert SplitConformal(one).calibrate(parts[0], y[:, 0]).predict(parts[0]).contains(y[:, 0]).shape == (30, 1)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda p, y: (np.where(p == p.max(), np.nan, p), y), "NaN"),
        (lambda p, y: (p * 2, y), "sum to 1"),
        (lambda p, y: (p - 0.5, y), "negative"),
        (lambda p, y: (p[:, :1], y), r"shape \(n, 2, K\)"),
        (lambda p, y: (p[:, :, :-1], y), "7 bins"),
        (lambda p, y: (p, y[:-1]), "y has"),
        (lambda p, y: (p, y[:, :1]), "expected 2"),
        (lambda p, y: (p, np.where(y == y.max(), np.inf, y)), "finite"),
    ],
)
def test_bad_arrays_are_refused_by_name(problem, spoil, match):
    bins, proba, y = problem(4)
    with pytest.raises(ConformalError, match=match):
        SplitConformal(bins).calibrate(*spoil(proba, y))


def test_bad_settings_are_refused(problem):
    bins, proba, _ = problem(5)
    for kwargs in ({"alpha": 90}, {"score": "best"}, {"score": 3}, {"joint": "all"}):
        with pytest.raises(ConformalError, match=next(iter(kwargs))):
            SplitConformal(bins, **kwargs)
    with pytest.raises(NotCalibratedError):
        SplitConformal(bins).predict(proba)
    with pytest.raises(ConformalError, match="scores must have shape"):
        SplitConformal(bins).calibrate_scores(np.zeros(3))


def test_a_score_of_ones_own(problem):
    class Margin:
        name = "margin"

        def of_bins(self, proba, widths):
            return proba.max(axis=1, keepdims=True) - proba

    bins, proba, y = problem(6)
    cal = SplitConformal(bins, 0.2, Margin()).calibrate(proba, y)
    np.testing.assert_array_equal(cal.predict(proba).contains(y), cal.score_samples(proba, y) <= cal.thresholds_)


def test_coverage_band_is_central_and_exact():
    low, high = coverage_band(99, 50, 0.1, level=0.9)
    law = stats.betabinom(50, 90, 10)
    assert law.cdf(low * 50 - 1) <= 0.05 < law.cdf(low * 50)
    assert law.cdf(high * 50 - 1) < 0.95 <= law.cdf(high * 50)
    assert coverage_band(5, 10, 0.1) == (1.0, 1.0)
    assert check_coverage(np.ones(50, bool), 99, 0.1).coverage == 1
    assert not check_coverage(np.arange(50) < 25, 99, 0.1).inside
    for bad in (
        lambda: coverage_band(9, 0, 0.1),
        lambda: coverage_band(9, 9, 0.1, 1),
        lambda: check_coverage([], 9, 0.1),
    ):
        with pytest.raises(ConformalError):
            bad()
