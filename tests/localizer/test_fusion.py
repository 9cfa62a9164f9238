import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import angle_between_quats
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.fusion import AGREE, fuse, inlier_odds
from conformodal.localizer.mixtures import PoseMixture


def quats(*angles):
    return Rotation.from_rotvec([[0, a, 0] for a in angles]).as_quat(scalar_first=True)


def modes(positions, spread=0.1, mass=None, angles=None, turn=0.1):
    positions = np.atleast_2d(np.asarray(positions, float))
    n = len(positions)
    angles = [0.0] * n if angles is None else angles
    log_mass = np.log(np.full(n, 1 / n) if mass is None else mass)
    poses = positions, np.full((n, 3), spread), quats(*angles), np.full(n, turn)
    return PoseMixture.weighted(*poses, log_mass, measured=False)


def estimate(position, sigma=0.05, angle=0.0, turn=0.05, probability=0.9):
    return PoseMeasurement(np.asarray(position, float), quats(angle)[0], sigma, turn, 100, probability)


def masses(mixture):
    return mixture.weights


def unmeasured_mass(mixture):
    """Probability that no estimate is right."""
    mass = masses(mixture)
    return mass[~mixture.measured].sum() / mass.sum()


@pytest.mark.parametrize("answers", [[], [[]], [[], []]])
def test_an_image_without_estimates_keeps_its_modes(answers):
    own = modes([[0, 0, 0], [5, 0, 0]])
    found = fuse(own, answers)
    assert found is own
    assert found.measured.tolist() == [False, False]
    assert unmeasured_mass(found) == 1


@pytest.mark.parametrize("probability", [0.02, 0.3, 0.9, 0.99])
@pytest.mark.parametrize("position", [[0.1, 0, 0], [4, 0, 0]])
def test_estimate_takes_probability_from_all_modes(position, probability):
    """Probabilities are added: that a mode is near makes neither more probable."""
    found = fuse(modes([[0, 0, 0], [3, 0, 0]], mass=[0.3, 0.7]), [[estimate(position, probability=probability)]])
    expected = [(0.3 * (1 - probability), 0.0), (0.7 * (1 - probability), 3.0), (probability, position[0])]
    expected.sort(reverse=True)
    np.testing.assert_allclose(masses(found), [mass for mass, _ in expected], rtol=1e-12)
    np.testing.assert_array_equal(found.positions_xyz[:, 0], [x for _, x in expected])
    assert unmeasured_mass(found) == pytest.approx(1 - probability, rel=1e-12)


def test_of_one_sources_estimates_at_most_one_is_right():
    its = [
        estimate([1, 0, 0], probability=0.8),
        estimate([2, 0, 0], probability=0.5),
        estimate([3, 0, 0], probability=0.5),
    ]
    none, right = inlier_odds(its)
    np.testing.assert_allclose(np.exp([none, *right]), np.array([1, 4, 1, 1]) / 7, rtol=1e-12)
    found = fuse(modes([[0, 0, 0]]), [its])
    np.testing.assert_allclose(masses(found), [4 / 7, 1 / 7, 1 / 7, 1 / 7], rtol=1e-12)
    assert found.measured.sum() == 3
    # near to each other they are not taken together either
    together = fuse(modes([[0, 0, 0]]), [[estimate([1, 0, 0], probability=0.8), estimate([1, 0, 0], probability=0.5)]])
    np.testing.assert_allclose(masses(together), [4 / 6, 1 / 6, 1 / 6], rtol=1e-12)
    np.testing.assert_array_equal(together.position_spreads[together.measured], 0.05)


def test_agreeing_sources_sharpen_the_estimate():
    """They make it no more probable."""
    first, second = estimate([0, 0, 0], 0.2, 0.0, 0.2, 0.9), estimate([0.1, 0, 0], 0.1, 0.1, 0.1, 0.8)
    found = fuse(modes([[3, 0, 0]]), [[first], [second]])
    best = found
    # the product of two normal densities
    np.testing.assert_allclose(best.positions_xyz[0], [0.08, 0, 0], atol=1e-12)
    np.testing.assert_allclose(best.position_spreads[0], 1 / np.sqrt(1 / 0.2**2 + 1 / 0.1**2))
    assert angle_between_quats(best.orientations_quat_wxyz[0], quats(0.08)[0]) == pytest.approx(0, abs=1e-7)
    assert best.orientation_spreads_rad[0] == pytest.approx(1 / np.sqrt(1 / 0.2**2 + 1 / 0.1**2))
    assert (best.position_spreads[0] < min(first.sigma_m, second.sigma_m)).all()
    # the later source's probability is its own; what the other has is left where that one is wrong
    np.testing.assert_allclose(masses(found), [0.8, 0.9 * 0.2, 0.1 * 0.2], rtol=1e-6)
    assert unmeasured_mass(found) == pytest.approx(0.1 * 0.2, rel=1e-6)
    np.testing.assert_array_equal(best.position_spreads[1:], [[0.2] * 3, [0.1] * 3])


@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_estimates_agree_up_to_a_distance_in_standard_deviations(angle):
    """Of position and orientation together; beyond it neither pulls at the other."""
    along = np.sqrt((AGREE - angle**2 / 0.005) * (0.2**2 + 0.1**2))
    first = estimate([0, 0, 0], 0.2)
    for off, moved in ((0.999, True), (1.001, False)):
        second = estimate([off * along, 0, 0], 0.1, angle, probability=0.8)
        found = fuse(modes([[9, 0, 0]]), [[first], [second]])
        assert (found.positions_xyz[0, 0] < second.position_xyz[0]) == moved
        assert (found.position_spreads[0, 0] < 0.1) == moved
        assert np.exp(found.log_weights[0]) == pytest.approx(0.8)
