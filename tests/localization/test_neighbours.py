import numpy as np
import pytest

from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.neighbours.regression import LocalAnswers, LocalSettings
from conformodal.localization.neighbours.source import NeighbourSource
from conformodal.localization.neighbours.tuning import fit_local

SETTINGS = [LocalSettings(6, 12, 0.03, None)]


def poses_of(x):
    """A smooth map from six features to poses: positions, and turns about z."""
    angle = x[:, 2] / 2
    positions = np.column_stack((np.sin(x[:, 0]), np.sin(x[:, 1]), x[:, 3]))
    return np.column_stack((positions, np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)))


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, size=(600, 6)).astype(np.float32)
    y = poses_of(x)
    regression, left_out = fit_local(x, y, np.ones(7), np.arange(600), choices=SETTINGS)
    return NeighbourSource.of(regression, left_out, np.arange(600)), x, y


def answered(source, answers, novelty):
    """The source's estimates where its regression answers so, at a novelty in units of features."""
    told = LocalAnswers(answers.values, answers.weights, np.full(len(answers.values), novelty))
    relative = np.full(len(answers.values), novelty / source.typical)
    rows = zip(told.values, told.weights, relative.tolist(), strict=True)
    return [source._measurements(*row) for row in rows]


def test_errors_are_as_large_as_the_standard_deviations(world):
    source, _, _ = world
    x = np.random.default_rng(1).uniform(-0.9, 0.9, size=(400, 6)).astype(np.float32)
    truth = poses_of(x)
    estimates = [here[0] for here in source.answer(FrameEvidence(x)).measurements]
    off = np.array([np.linalg.norm(f.position_xyz - t[:3]) for f, t in zip(estimates, truth, strict=True)])
    sigma = np.array([f.sigma_m for f in estimates])
    # the median norm of three errors of spread one is 1.54
    assert np.median(off / sigma) == pytest.approx(1.54, rel=0.25)
    assert np.median([f.inlier_probability for f in estimates]) > 0.9
    turned = np.array(
        [2 * np.arccos(min(abs(f.orientation_quat_wxyz @ t[3:]), 1)) for f, t in zip(estimates, truth, strict=True)]
    )
    assert np.median(turned / [f.sigma_rad for f in estimates]) == pytest.approx(1.54, rel=0.5)  # about one axis only


def test_novel_images_have_wider_and_less_probable_estimates(world):
    source, x, _ = world
    answers = source.regression.predict(x[:50])
    estimates = [answered(source, answers, s)[0][0] for s in (source.typical, 3 * source.limit, 30 * source.limit)]
    probabilities, spreads = [f.inlier_probability for f in estimates], [f.sigma_m for f in estimates]
    assert probabilities[0] > 0.9
    assert probabilities[0] > probabilities[1] > probabilities[2]
    assert probabilities[2] < 1e-3
    assert spreads[0] < spreads[1] / 3 < spreads[2] / 10


def test_every_place_that_looks_alike_has_an_estimate_with_its_share_of_the_odds(world):
    source, _, y = world
    values = np.stack((y[0], y[1], y[2]))[None]
    shares = LocalAnswers(values, np.array([[0.25, 0.75, 0.0]]), np.ones(1))
    here = answered(source, shares, source.typical)[0]
    assert len(here) == 2  # a place without neighbours is none
    np.testing.assert_allclose(here[0].position_xyz, y[0, :3])
    odds = [one.inlier_probability / (1 - one.inlier_probability) for one in here]
    assert odds[1] == pytest.approx(3 * odds[0])
    # all together are as likely to be right as one place would be
    single = LocalAnswers(values, np.array([[1.0, 0.0, 0.0]]), np.ones(1))
    alone = answered(source, single, source.typical)[0][0]
    assert sum(odds) == pytest.approx(alone.inlier_probability / (1 - alone.inlier_probability))


def test_what_is_typical_comes_from_samples_left_out(world):
    source, x, _ = world
    novelty = source.regression.predict(x + 0.01).novelty / source.typical
    assert 0.05 < np.median(novelty) < 2
    assert source.typical <= source.limit


def test_too_few_samples_make_no_source():
    x = np.random.default_rng(0).uniform(-1, 1, size=(12, 6)).astype(np.float32)
    regression, left_out = fit_local(x, poses_of(x), np.ones(7), np.arange(12), choices=SETTINGS)
    assert NeighbourSource.of(regression, left_out, np.arange(12)) is None
