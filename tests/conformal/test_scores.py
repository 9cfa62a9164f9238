import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from conformodal.conformal import Aps, SplitConformal
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


def test_aps_counts_what_is_ranked_before_and_a_random_share_of_its_own():
    proba = np.array([[0.5, 0.3, 0.2]])
    plain = Aps(share=1).of_bins(proba, np.ones(3))
    np.testing.assert_allclose(plain, [[0.5, 0.8, 1.0]])
    u = row_uniforms(proba)[0]
    np.testing.assert_allclose(Aps().of_bins(proba, np.ones(3)), [[0.5 * u, 0.5 + 0.3 * u, 0.8 + 0.2 * u]])
    by_density = Aps("density", share=1).of_bins(proba, np.array([5.0, 1.0, 1.0]))
    np.testing.assert_allclose(by_density, [[1.0, 0.3, 0.5]])


def test_the_random_shares_are_uniform_and_belong_to_the_row():
    rows = np.random.default_rng(0).dirichlet(np.ones(5), 20_000)
    u = row_uniforms(rows)
    counts = np.histogram(u, 20, (0, 1))[0]
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)
    np.testing.assert_array_equal(row_uniforms(rows[::-1]), u[::-1])
    assert abs(np.corrcoef(u, rows[:, 0])[0, 1]) < 0.03
