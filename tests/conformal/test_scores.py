import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformodal.conformal import Aps, ConformalError, LinearDensity, QuantileBins, SplitConformal
from conformodal.conformal.scores import SCORES, row_uniforms


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(sorted(SCORES)), st.sampled_from(["none", "bonferroni", "max"]))
def test_sets_nest_in_alpha_and_ignore_the_order_of_calibration(problem, seed, score, joint):
    bins, proba, y = problem(seed)

    def calibrated(rows):
        return SplitConformal(bins, 0.3, score, joint).fit_scale(proba[50:], y[50:]).calibrate(proba[rows], y[rows])

    one = calibrated(np.arange(50))
    other = calibrated(np.random.default_rng(seed).permutation(50))
    tight, loose, same = one.predict(proba), one.at(0.1).predict(proba), other.predict(proba)
    for a, b, c in zip(tight.masks, loose.masks, same.masks, strict=True):
        assert not (a & ~b).any()
        np.testing.assert_array_equal(a, c)


def test_linear_density_is_between_those_of_the_centres_and_keeps_a_flat_density():
    widths = np.array([1.0, 2.0, 1.0])
    flat = LinearDensity(4).of_bins(np.array([[0.25, 0.5, 0.25]]), widths)
    np.testing.assert_allclose(flat, -0.25)
    peak = -LinearDensity(4).of_bins(np.array([[0.1, 0.8, 0.1]]), widths)[0]
    assert peak.shape == (12,)
    assert peak[[0, 1]] == pytest.approx([0.1, 0.1])  # beyond the outer centre: the outer bin's
    assert (np.diff(peak[:6]) >= 0).all()


def test_an_interval_may_end_within_a_bin():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.linspace(-4, 4, 17)])
    proba = np.exp(-0.5 * bins.centers[0] ** 2)[None].repeat(3000, axis=0)
    proba /= proba.sum(axis=1, keepdims=True)
    y = rng.normal(size=3000)
    sets = {name: SplitConformal(bins, 0.1, name).calibrate(proba, y).predict(proba[:1]) for name in SCORES}
    low = sets["linear_density"].intervals(0)[0][0, 0]
    assert low not in bins.edges_[0]
    assert abs(low + 1.645) < 0.13  # the 5 % quantile of the normal distribution, to a cell of 0.125
    assert sets["linear_density"].length[0, 0] <= sets["density"].length[0, 0]


def test_aps_counts_what_is_ranked_before_and_a_random_share_of_its_own():
    proba = np.array([[0.5, 0.3, 0.2]])
    plain = Aps(randomized=False).of_bins(proba, np.ones(3))
    np.testing.assert_allclose(plain, [[0.5, 0.8, 1.0]])
    u = row_uniforms(proba, seed=0)[0]
    np.testing.assert_allclose(Aps().of_bins(proba, np.ones(3)), [[0.5 * u, 0.5 + 0.3 * u, 0.8 + 0.2 * u]])
    by_density = Aps("density", randomized=False).of_bins(proba, np.array([5.0, 1.0, 1.0]))
    np.testing.assert_allclose(by_density, [[1.0, 0.3, 0.5]])
    with pytest.raises(ConformalError, match="order"):
        Aps("size")


def test_the_random_shares_are_uniform_and_belong_to_the_row():
    rows = np.random.default_rng(0).dirichlet(np.ones(5), 20_000)
    u = row_uniforms(rows)
    counts = np.histogram(u, 20, (0, 1))[0]
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)
    np.testing.assert_array_equal(row_uniforms(rows[::-1]), u[::-1])
    assert abs(np.corrcoef(u, rows[:, 0])[0, 1]) < 0.03
    assert (row_uniforms(rows, seed=1) != u).all()
