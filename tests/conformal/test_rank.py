import numpy as np
import pytest

import conformodal.conformal as cm


def exact(n: int, thousandths: int) -> int:
    return -(-(n + 1) * (1000 - thousandths) // 1000)


@pytest.mark.parametrize("n", [*range(1, 40), 99, 100, 199, 499, 500, 999, 1000, 1999, 2000])
def test_rank_is_exact_for_every_alpha_in_thousandths(n):
    found = [cm.conformal_rank(n, a / 1000) for a in range(1, 1000)]
    assert found == [exact(n, a) for a in range(1, 1000)]


def test_quantile_is_the_kth_smallest_and_keeps_its_type():
    scores = np.random.default_rng(0).random((57, 3)).astype(np.float32)
    k = cm.conformal_rank(57, 0.13)
    found = cm.conformal_quantile(scores, 0.13)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.sort(scores, axis=0)[k - 1])
    np.testing.assert_array_equal(cm.conformal_quantile(scores.T, 0.13, axis=1), found)


def test_quantile_is_infinite_where_data_is_short():
    assert cm.conformal_quantile(np.zeros(8), 0.1) == np.inf
    assert cm.conformal_quantile(np.zeros(9), 0.1) == 0
    assert cm.conformal_quantile(np.empty((0, 2)), 0.1).tolist() == [np.inf, np.inf]


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
    bins = cm.QuantileBins.from_edges([np.arange(n + 2.0)])
    proba = np.full((n, n + 1), 1 / (n + 1))
    y, same = np.random.default_rng(n).permutation(n) + 0.5, np.zeros(n)
    settings = (bins, alpha, PlaceScore())
    yield cm.SplitConformal(*settings).calibrate(proba, y).predict(proba[:1])
    yield cm.SplitConformal(*settings, joint="bonferroni").calibrate(proba, y).predict(proba[:1])
    scaled = cm.SplitConformal(*settings, joint="max").fit_scale(proba, y)
    yield scaled.calibrate(proba, y).predict(proba[:1])
    yield cm.SplitConformal(bins, 0.5, PlaceScore()).calibrate(proba, y).at(alpha).predict(proba[:1])
    yield cm.MondrianConformal(*settings).calibrate(proba, y, same).predict(proba[:1], [0])


def test_every_calibrator_where_floats_would_miss():
    missed = missed_by_floats(120)
    assert len(missed) > 20
    for n, a in [*missed, (1, 500), (1, 499), (9, 100), (8, 100), (999, 1), (998, 1)]:
        k = exact(n, a)
        for regions in calibrators(n, a / 1000):
            assert regions.unbounded[0, 0] == (k > n)
            assert regions.masks[0].sum() == (k if k <= n else n + 1)
