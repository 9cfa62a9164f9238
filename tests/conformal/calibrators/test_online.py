"""The bounds that trackers state, against sequences that are chosen by someone who knows the thresholds."""

from fractions import Fraction
from math import inf, nextafter

import numpy as np
import pytest

from conformodal.conformal import Aci, OnlineConformal, QuantileBins

T = 1200


def just_above(limit, t, rng):
    if limit == inf:
        return 0.0
    return -1.0 if limit == -inf else nextafter(limit, inf)


def above_or_at(limit, t, rng):
    return just_above(limit, t, rng) if t % 2 else min(max(limit, -1e6), 1e6)


# a score from the threshold, the time and random numbers
ADVERSARIES = {
    "just above": just_above,
    "above and at": above_or_at,
    "twice as far": lambda limit, t, rng: 2 * abs(limit) + 1 if abs(limit) < 1e150 else 0.0,
    "always below": lambda limit, t, rng: min(limit, 1e6) - 1 if limit > -inf else -inf,
    "growing fast": lambda limit, t, rng: 2.0 ** (t / 3),
    "inf at times": lambda limit, t, rng: inf if t % 700 < 50 else rng.normal(),
    "-inf then inf": lambda limit, t, rng: -inf if t < T / 2 else inf,
    "largest floats": lambda limit, t, rng: 1.7e308 if t % 2 else -1.7e308,
    "walk": lambda limit, t, rng: float(rng.normal() + 30 * np.sin(t / 50)),
    "inf against finite": lambda limit, t, rng: inf if limit < inf else 0.0,
}


def play(tracker, adversary, steps=T):
    """Whether each score was missed; the empty set misses -inf too."""
    rng = np.random.default_rng(0)
    missed = []
    for t in range(steps):
        limit = tracker.threshold()
        assert limit == limit
        score = adversary(limit, t, rng)
        missed.append(score > limit or tracker.alpha_t >= 1)
        tracker.update(score)
    return np.array(missed)


@pytest.mark.parametrize("adversary", ADVERSARIES)
@pytest.mark.parametrize(("alpha", "gamma", "window"), [("0.1", 0.005, None), ("0.1", 0.1, 20), ("0.9", 0.05, None)])
def test_aci_keeps_its_bound_at_every_step(adversary, alpha, gamma, window):
    missed = play(Aci(alpha, gamma, window), ADVERSARIES[adversary])
    rate, step = Fraction(alpha), Fraction(str(gamma))
    bound = (max(rate, 1 - rate) + step) / step
    for steps, total in enumerate(np.cumsum(missed).tolist(), 1):
        assert abs(total - steps * rate) <= bound, steps


def test_the_empty_set_misses_minus_infinity():
    tracker = Aci(0.5, 0.25)
    for _ in range(50):
        tracker.update(-inf)
    assert tracker.alpha_t <= 1 + Fraction(1, 4)


# pushes the truth into the bin of the largest score: the worst that a set over bins can meet
@pytest.mark.parametrize("gamma", [0.005, 0.05])
@pytest.mark.parametrize("score", ["lac", "hpd"])
def test_online_sets_keep_the_bound_of_their_tracker(gamma, score):
    bins = QuantileBins.from_edges([np.array([0, 1, 3, 4, 8.0])])
    rng = np.random.default_rng(1)
    proba = rng.dirichlet(np.ones(4), T)
    stream = OnlineConformal(bins, 0.1, score, gamma)
    held = []
    for row in proba:
        regions = stream.predict(row[None])
        out = np.flatnonzero(~regions.masks[0][0])
        y = bins.centers[0][out[0]] if out.size else 9.0  # beyond the edges only the whole line holds
        held.append(regions.contains([y])[0, 0])
        stream.update(row[None], [y])
    share = 1 - np.cumsum(held) / np.arange(1, T + 1)
    assert abs(share[-1] - 0.1) <= (0.9 + gamma) / (gamma * T)


def test_a_window_bounds_what_is_kept():
    tracker = Aci(0.1, window=50)
    play(tracker, ADVERSARIES["walk"], 500)
    assert len(tracker.past) == 50


def test_sets_are_those_of_the_trackers():
    rng = np.random.default_rng(2)
    bins = QuantileBins.from_edges([np.linspace(0, 1, 11)])
    proba, y = rng.dirichlet(np.ones(10), 400), rng.random(400)
    whole = OnlineConformal(bins, 0.2).run(proba, y)
    one = OnlineConformal(bins, 0.2)
    for i in range(400):
        np.testing.assert_array_equal(one.predict(proba[i : i + 1]).masks[0][0], whole.masks[0][i])
        one.update(proba[i : i + 1], y[i : i + 1])
