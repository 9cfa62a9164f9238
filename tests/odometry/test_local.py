import numpy as np
import pytest

from conformodal.conformal import QuantileBins
from conformodal.odometry.local import make_finder, place_labels
from conformodal.vision import LocalAnswers, LocalSettings, fit_local

SIGMA = 0.7


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, size=(400, 6)).astype(np.float32)
    y = np.column_stack((np.sin(x[:, :2]).sum(axis=1), x[:, 2]))
    regression, left_out = fit_local(x, y, y.std(axis=0), np.arange(400), choices=[LocalSettings(6, 12, 0.03, None)])
    return QuantileBins(20, 0.02).fit(y), make_finder(regression, left_out, SIGMA), x, y


def flat(bins, n):
    return [np.full((n, k), 1 / k) for k in bins.sizes]


def test_a_usual_image_is_answered_by_halves_and_a_strange_one_by_the_others(world):
    bins, finder, x, _ = world
    answers = finder.regression.predict(x[:50])
    shares = []
    for strangeness in (finder.typical, 3 * finder.limit, 30 * finder.limit):
        told = LocalAnswers(answers.values, answers.weights, np.full(50, strangeness))
        blended = finder.blend(flat(bins, 50), told, bins)
        for block in blended:
            np.testing.assert_allclose(block.sum(axis=1), 1)
        own = place_labels(answers, bins, SIGMA)[0]
        shares.append(np.median((blended[0] - 1 / 20) / (own - 1 / 20)))
    assert shares[0] == pytest.approx(0.5)
    assert shares[1] < 0.02
    assert shares[2] < 1e-5


def test_labels_have_a_peak_for_every_place(world):
    bins, _, _, _ = world
    values = np.array([[[-1.0, -0.5], [1.0, 0.5]]])
    labels = place_labels(LocalAnswers(values, np.array([[0.25, 0.75]]), np.ones(1)), bins, SIGMA)
    low, high = (bins.encode(v)[0, 0] for v in (values[:, 0], values[:, 1]))
    assert labels[0][0, low] * 3 == pytest.approx(labels[0][0, high], rel=0.2)
    assert labels[0][0, (low + high) // 2] < 1e-3
    assert labels[0].sum() == pytest.approx(1)


def test_what_is_typical_comes_from_samples_left_out(world):
    _, finder, x, _ = world
    strange = finder.strangeness(finder.regression.predict(x + 0.01))
    assert 0.05 < np.median(strange) < 2
    assert finder.typical <= finder.limit
    assert finder.growth >= 0
