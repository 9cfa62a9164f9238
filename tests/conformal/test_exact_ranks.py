"""Every path that computes a threshold, against rational arithmetic."""

from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import (
    CrossConformal,
    MondrianConformal,
    QuantileBins,
    SplitConformal,
    WeightedConformal,
    conformal_quantile,
    conformal_rank,
)
from conformodal.conformal.calibration.weighted import WeightedRanks
from conformodal.conformal.online import PastScores


def exact(n: int, thousandths: int) -> int:
    return -(-(n + 1) * (1000 - thousandths) // 1000)


@pytest.mark.slow
def test_ranks_to_2000_in_thousandths():
    # every n, and for each n every 37th rate, starting at another one
    past = PastScores()
    for n in range(1, 2001):
        past.add(float(n))
        scores = np.arange(1, n + 1, dtype=float)
        weights = WeightedRanks([0.1] * n, [0.1])
        for a in range(1 + n * 7 % 37, 1000, 37):
            alpha, k = Fraction(a, 1000), exact(n, a)
            assert conformal_rank(n, a / 1000) == k
            assert weights.at(alpha)[0] == k
            assert conformal_quantile(scores, alpha) == past.threshold(alpha) == (k if k <= n else np.inf)


def missed_by_floats(most):
    pairs = [(n, a) for n in range(1, most + 1) for a in range(1, 1000)]
    return [(n, a) for n, a in pairs if int(np.ceil((n + 1) * (1 - a / 1000))) != exact(n, a)]


class PlaceScore:
    """A bin's score is its number, whatever its probability."""

    name = "place"

    def of_bins(self, proba, widths):
        return np.broadcast_to(np.arange(widths.size, dtype=float), proba.shape)


def calibrators(n, alpha):
    """Sets of one new sample after calibration with one sample in each of n bins, of n + 1."""
    bins = QuantileBins.from_edges([np.arange(n + 2.0)])
    proba = np.full((n, n + 1), 1 / (n + 1))
    y, same = np.random.default_rng(n).permutation(n) + 0.5, np.zeros(n)
    settings = (bins, alpha, PlaceScore())
    yield SplitConformal(*settings).calibrate(proba, y).predict(proba[:1])
    yield SplitConformal(*settings, joint="bonferroni").calibrate(proba, y).predict(proba[:1])
    scaled = SplitConformal(*settings, joint="max").fit_scale(proba, y)
    yield scaled.calibrate(proba, y).predict(proba[:1])
    yield SplitConformal(bins, 0.5, PlaceScore()).calibrate(proba, y).at(alpha).predict(proba[:1])
    yield MondrianConformal(*settings).calibrate(proba, y, same).predict(proba[:1], [0])
    yield WeightedConformal(*settings).calibrate(proba, y, same + 0.3).predict(proba[:1], [0.3])
    yield CrossConformal(*settings).calibrate(proba, y, same).predict({0.0: proba[:1]})
    halves = CrossConformal(*settings).calibrate(proba, y, np.arange(n) % 2)
    yield halves.predict(dict.fromkeys(np.unique(np.arange(n) % 2), proba[:1]))


def test_every_calibrator_where_floats_would_miss():
    missed = missed_by_floats(200)
    assert len(missed) > 50
    for n, a in [*missed, (1, 500), (1, 499), (9, 100), (8, 100), (999, 1), (998, 1)]:
        k = exact(n, a)
        for regions in calibrators(n, a / 1000):
            assert regions.unbounded[0, 0] == (k > n)
            assert regions.masks[0].sum() == (k if k <= n else n + 1)
