import numpy as np
import pytest
from conformodal.odometry.local import make_finder

from conformodal.localization.neighbours import LocalAnswers, LocalSettings, fit_local

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
    return make_finder(regression, left_out), x, y


def told(answers, strangeness):
    return LocalAnswers(answers.values, answers.weights, np.full(len(answers.values), strangeness))


def test_fixes_are_as_far_off_as_they_claim(world):
    finder, _, _ = world
    x = np.random.default_rng(1).uniform(-0.9, 0.9, size=(400, 6)).astype(np.float32)
    truth = poses_of(x)
    fixes = [here[0] for here in finder.fixes(finder.regression.predict(x))]
    off = np.array([np.linalg.norm(f.position_xyz - t[:3]) for f, t in zip(fixes, truth, strict=True)])
    claimed = np.array([f.sigma_m for f in fixes])
    # the median norm of three errors of spread one is 1.54
    assert np.median(off / claimed) == pytest.approx(1.54, rel=0.25)
    assert np.median([f.trust for f in fixes]) > 0.9
    turned = np.array(
        [2 * np.arccos(min(abs(f.orientation_quat_wxyz @ t[3:]), 1)) for f, t in zip(fixes, truth, strict=True)]
    )
    assert np.median(turned / [f.sigma_rad for f in fixes]) == pytest.approx(1.54, rel=0.5)  # about one axis only


def test_the_stranger_an_image_the_less_its_fix_is_trusted(world):
    finder, x, _ = world
    answers = finder.regression.predict(x[:50])
    fixes = [finder.fixes(told(answers, s))[0][0] for s in (finder.typical, 3 * finder.limit, 30 * finder.limit)]
    trusts, spreads = [f.trust for f in fixes], [f.sigma_m for f in fixes]
    assert trusts[0] > 0.9
    assert trusts[0] > trusts[1] > trusts[2]
    assert trusts[2] < 1e-3
    assert spreads[0] < spreads[1] / 3 < spreads[2] / 10


def test_every_place_that_looks_alike_has_a_fix_with_its_share_of_the_odds(world):
    finder, _, y = world
    values = np.stack((y[0], y[1], y[2]))[None]
    here = finder.fixes(LocalAnswers(values, np.array([[0.25, 0.75, 0.0]]), np.full(1, finder.typical)))[0]
    assert len(here) == 2  # a place without neighbours is none
    np.testing.assert_allclose(here[0].position_xyz, y[0, :3])
    odds = [fix.trust / (1 - fix.trust) for fix in here]
    assert odds[1] == pytest.approx(3 * odds[0])
    # all together are as likely to be right as one place would be
    alone = finder.fixes(LocalAnswers(values, np.array([[1.0, 0.0, 0.0]]), np.full(1, finder.typical)))[0][0]
    assert sum(odds) == pytest.approx(alone.trust / (1 - alone.trust))


def test_what_is_typical_comes_from_samples_left_out(world):
    finder, x, _ = world
    strange = finder.strangeness(finder.regression.predict(x + 0.01))
    assert 0.05 < np.median(strange) < 2
    assert finder.typical <= finder.limit


def test_too_few_samples_make_no_finder():
    x = np.random.default_rng(0).uniform(-1, 1, size=(12, 6)).astype(np.float32)
    regression, left_out = fit_local(x, poses_of(x), np.ones(7), np.arange(12), choices=SETTINGS)
    assert make_finder(regression, left_out) is None
