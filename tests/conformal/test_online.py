from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import Aci, ConformalError, ConformalPid, OnlineConformal, QuantileBins


def misses(tracker, scores):
    missed = 0
    for s in scores:
        missed += s > tracker.threshold()
        tracker.update(s)
    return missed / len(scores)


@pytest.mark.parametrize("seed", range(5))
def test_aci_keeps_its_bound_on_any_sequence(seed):
    rng = np.random.default_rng(seed)
    scores = rng.normal(size=2000).cumsum() + np.where(np.arange(2000) % 700 < 50, np.inf, 0)
    gamma = 0.02
    assert abs(misses(Aci(0.1, gamma), scores) - 0.1) <= (0.9 + gamma) / (2000 * gamma)


def test_alpha_is_not_clipped():
    tracker = Aci(0.1, 0.5)
    for s in range(20):
        tracker.update(s)
    assert tracker.alpha_t < 0
    assert tracker.threshold() == np.inf
    easy = Aci(0.9, 0.5)
    for s in range(20):
        easy.update(-s)
    assert easy.alpha_t > Fraction(9, 10)


def test_coverage_follows_a_drift():
    rng = np.random.default_rng(1)
    scores = np.abs(rng.normal(size=4000)) * (1 + 3 * (np.arange(4000) > 2000))
    tracker = ConformalPid(0.1)
    first = misses(tracker, scores[:2000])
    second = misses(tracker, scores[2000:])
    assert abs(first - 0.1) < 0.03
    assert abs(second - 0.1) < 0.03


def test_sets_are_those_of_the_trackers():
    rng = np.random.default_rng(2)
    bins = QuantileBins.from_edges([np.linspace(0, 1, 11)])
    proba, y = rng.dirichlet(np.ones(10), 400), rng.random(400)
    whole = OnlineConformal(bins, 0.2, method="aci").run(proba, y)
    one = OnlineConformal(bins, 0.2, method="aci")
    for i in range(400):
        np.testing.assert_array_equal(one.predict(proba[i : i + 1]).masks[0][0], whole.masks[0][i])
        one.update(proba[i : i + 1], y[i : i + 1])


def test_errors():
    with pytest.raises(ConformalError, match="gamma"):
        Aci(0.1, 0)
    with pytest.raises(ConformalError, match="NaN"):
        Aci(0.1).update(float("nan"))
    with pytest.raises(ConformalError, match="method"):
        OnlineConformal(QuantileBins.from_edges([[0, 1]]), method="dtaci")
