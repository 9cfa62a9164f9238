import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from conformodal.poses import PoseFix, angle_between_quats
from conformodal.reasoning import Candidates, add_fixes
from conformodal.reasoning.fixes import LOOK_ALIKE, NOWHERE


def quats(*angles):
    return Rotation.from_rotvec([[0, a, 0] for a in angles]).as_quat(scalar_first=True)


def candidates(positions, spread=0.1, log_mass=None, angles=None, turn=0.1):
    positions = np.atleast_2d(np.asarray(positions, float))
    n = len(positions)
    angles = [0.0] * n if angles is None else angles
    mass = np.log(np.full(n, 1 / n)) if log_mass is None else np.asarray(log_mass)
    return Candidates(positions, np.full((n, 3), spread), quats(*angles), np.full(n, turn), mass)


def fix(position, sigma=0.05, angle=0.0, turn=0.05, trust=0.9):
    return PoseFix(np.asarray(position, float), quats(angle)[0], sigma, turn, 100, trust)


def test_without_fixes_nothing_changes():
    own = candidates([[0, 0, 0], [5, 0, 0]])
    assert add_fixes(own, [], 100.0) is own


def test_masses_are_those_of_bayes_rule():
    volume, own, its = 50.0, candidates([[0, 0, 0], [3, 0, 0]], 0.2, np.log([0.3, 0.7])), fix([0.1, 0, 0], 0.1)
    found = add_fixes(own, [its], volume)
    s = np.hypot(0.2, 0.1)
    facing = norm.pdf(0, 0, np.hypot(0.1, 0.05)) ** 3
    overlap = [norm.pdf(d, 0, s) * norm.pdf(0, 0, s) ** 2 * facing for d in (0.1, 2.9)]
    odds = its.trust / (1 - its.trust)
    both = [mass * (1 - NOWHERE) * o for mass, o in zip((0.3, 0.7), overlap, strict=True)]
    anywhere = 1 / (volume * 8 * np.pi**2)
    wrong = LOOK_ALIKE * sum(both) + (1 - LOOK_ALIKE) * anywhere  # density of a wrong fix where this one is
    weights = {
        "old 0": 0.3 * (1 - NOWHERE),
        "old 1": 0.7 * (1 - NOWHERE),
        "both 0": both[0] / wrong * odds,
    }
    too_few = (both[1] + NOWHERE * anywhere) / wrong * odds  # near the second one alone, and the fix alone
    total = sum(weights.values()) + too_few
    expected = sorted((w / total for w in weights.values()), reverse=True)
    np.testing.assert_allclose(np.exp(found.log_mass), expected, rtol=1e-6)


def test_where_they_agree_means_are_weighed_by_their_variances():
    found = add_fixes(candidates([[0, 0, 0]], 0.2, angles=[0.0], turn=0.2), [fix([0.1, 0, 0], 0.1, 0.1, 0.1)], 50.0)
    np.testing.assert_allclose(found.positions_xyz[0], [0.08, 0, 0])
    np.testing.assert_allclose(found.position_spreads[0], 1 / np.sqrt(1 / 0.2**2 + 1 / 0.1**2))
    assert angle_between_quats(found.orientations_quat_wxyz[0], quats(0.08)[0]) == pytest.approx(0, abs=1e-7)
    assert found.orientation_spreads_rad[0] == pytest.approx(1 / np.sqrt(1 / 0.2**2 + 1 / 0.1**2))


def test_a_fix_far_from_every_candidate_is_one_itself():
    found = add_fixes(candidates([[0, 0, 0]]), [fix([4, 0, 0], trust=0.95)], 500.0)
    # 0.05 * 19 * 2 against 0.95: trusted at 19 to 1, and half of all wrong fixes are anywhere
    np.testing.assert_allclose(found.positions_xyz, [[4, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(np.exp(np.diff(found.log_mass)), 0.5)
    np.testing.assert_allclose(found.position_spreads[:, 0], [0.05, 0.1])


def test_a_fix_that_is_not_trusted_moves_nothing():
    own = candidates([[0, 0, 0], [5, 0, 0]], log_mass=np.log([0.6, 0.4]))
    found = add_fixes(own, [fix([5, 0, 0], trust=0.0)], 1.0)  # small volume: that they meet is no wonder
    np.testing.assert_allclose(found.positions_xyz[0], [0, 0, 0])


def test_of_several_fixes_the_candidates_choose():
    places = [[0, 0, 0], [5, 0, 0], [9, 0, 0]]
    own = candidates(places[:2], log_mass=np.log([0.9, 0.1]))
    found = add_fixes(own, [fix(place, trust=0.99) for place in places[1:]], 1000.0)
    np.testing.assert_allclose(found.positions_xyz[0], [5, 0, 0], atol=1e-9)
    assert np.exp(found.log_mass).sum() == pytest.approx(1, abs=1e-3)
    assert (np.diff(found.log_mass) <= 0).all()


def test_two_signs_of_a_quaternion_are_one_rotation():
    own = candidates([[0, 0, 0]], angles=[0.2])
    its = fix([0, 0, 0], angle=0.25)
    turned = PoseFix(its.position_xyz, -its.orientation_quat_wxyz, its.sigma_m, its.sigma_rad, 100, its.trust)
    one, other = (add_fixes(own, [f], 50.0) for f in (its, turned))
    np.testing.assert_allclose(one.log_mass, other.log_mass)
    assert angle_between_quats(one.orientations_quat_wxyz, other.orientations_quat_wxyz) == pytest.approx(0, abs=1e-7)
