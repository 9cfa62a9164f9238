from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import MotionStatus, RelativeMotion
from conformodal.reasoning.bridging import bridge, predict_candidates
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.observations import Observations
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.settings import SEARCH
from conformodal.reasoning.viterbi import viterbi

PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.5, 1.5), (0.5, 0.5))
SIGMA, STEP = 0.01, 0.1


def turns(n, seed=0):
    return Rotation.from_rotvec(np.random.default_rng(seed).normal(size=(n, 3)) * 0.3)


def motions_along(rotations):
    """Relative rotations between neighbours, exact."""
    led = [(rotations[t - 1].inv() * rotations[t]).as_matrix() for t in range(1, len(rotations))]
    return [None] + [RelativeMotion(MotionStatus.OK, R, rotation_sigma_rad=SIGMA) for R in led]


def candidates(*rotations, seed=0):
    rng = np.random.default_rng(seed)
    k = len(rotations)
    quats = np.array([r.as_quat(scalar_first=True) for r in rotations])
    mass = np.log(np.arange(k, 0, -1) / np.arange(1, k + 1).sum())
    return Candidates(rng.normal(size=(k, 3)), np.full((k, 3), 0.05), quats, np.full(k, 0.02), mass)


def angles(found, rotation):
    return (Rotation.from_quat(found.orientations_quat_wxyz, scalar_first=True) * rotation.inv()).magnitude()


def bridged(known, rotations, motions=None):
    own = [candidates(r, seed=t) for t, r in enumerate(rotations)]
    times = STEP * np.arange(len(own))
    return own, bridge(own, np.asarray(known, bool), motions or motions_along(rotations), times, PRIOR)


def led(found, own):
    """Of a frame that is bridged: what was predicted from its neighbour; of another, all."""
    if found is own:
        return found
    its = (found.positions_xyz[:, None] == own.positions_xyz).all(axis=2).any(axis=1)
    np.testing.assert_array_equal(found.positions_xyz[its], own.positions_xyz)
    np.testing.assert_allclose(np.exp(found.log_mass[its]).sum(), SEARCH.own_share)
    np.testing.assert_allclose(np.exp(found.log_mass).sum(), 1)
    assert (np.diff(found.log_mass) <= 0).all()  # most probable first
    return found.take(np.flatnonzero(~its))


def test_candidates_go_where_the_relative_rotations_lead_forward_and_back():
    rotations = turns(9)
    own, found = bridged([0, 0, 0, 1, 0, 0, 0, 1, 0], rotations)
    for t in (3, 7):
        assert found[t] is own[t]
    for t, here in enumerate(found):  # the chain is exact: every frame has its own rotation again
        predicted = led(here, own[t])
        assert angles(predicted, rotations[t])[0] == pytest.approx(0, abs=1e-7)
        source = own[7 if t >= 7 else 3]
        np.testing.assert_array_equal(predicted.positions_xyz, source.positions_xyz)


def test_all_candidates_turn_alike_and_none_is_preferred():
    one, other, turn = turns(3, seed=1)
    motion = RelativeMotion(MotionStatus.OK, turn.as_matrix(), rotation_sigma_rad=SIGMA)
    start = candidates(one, other)
    ahead = predict_candidates(start, motion, STEP, PRIOR)
    assert angles(ahead, one * turn)[0] == pytest.approx(0, abs=1e-7)
    assert angles(ahead, other * turn)[1] == pytest.approx(0, abs=1e-7)
    np.testing.assert_allclose(np.exp(ahead.log_mass), 0.5)
    again = predict_candidates(ahead, motion, STEP, PRIOR, back=True)
    for k, rotation in enumerate((one, other)):
        assert angles(again, rotation)[k] == pytest.approx(0, abs=1e-7)


def test_spreads_grow_by_what_the_camera_can_have_done():
    rotations = turns(6)
    own, found = bridged([1, 0, 0, 0, 0, 0], rotations)
    sigma = SEARCH.rotation_sigma_factor * SIGMA
    for t, here in enumerate(found):
        predicted = led(here, own[t])
        np.testing.assert_allclose(predicted.position_spreads, 0.05 + t * PRIOR.reach_m(STEP) / np.sqrt(3))
        np.testing.assert_allclose(predicted.orientation_spreads_rad, 0.02 + t * sigma)
    own, found = bridged([1, *[0] * 99], turns(100), [None] * 100)
    assert max(len(here.log_mass) for here in found) == 2  # they do not multiply along the way
    spreads = np.array([led(*pair).orientation_spreads_rad[0] for pair in zip(found, own, strict=True)])
    np.testing.assert_allclose(spreads[:20], 0.02 + np.arange(20) * PRIOR.turn_rate_rad_s * STEP)
    assert spreads[-1] == np.pi  # nothing is less known


def test_without_motion_orientations_stay():
    rotations = turns(3)
    own, found = bridged([1, 0, 0], rotations, [None, RelativeMotion(MotionStatus.OK), None])
    for pair in zip(found, own, strict=True):
        np.testing.assert_array_equal(led(*pair).orientations_quat_wxyz, own[0].orientations_quat_wxyz)


def test_frames_before_the_first_known_one_are_bridged_from_it():
    rotations = turns(5)
    own, found = bridged([0, 0, 0, 1, 1], rotations)
    assert found[3:] == own[3:]
    for t in range(3):
        predicted = led(found[t], own[t])
        assert angles(predicted, rotations[t])[0] == pytest.approx(0, abs=1e-7)
        np.testing.assert_array_equal(predicted.positions_xyz, own[3].positions_xyz)
        sigma = SEARCH.rotation_sigma_factor * SIGMA
        np.testing.assert_allclose(predicted.orientation_spreads_rad, 0.02 + (3 - t) * sigma)


def test_where_nothing_is_known_all_stays_as_it_is():
    own, found = bridged([0] * 4, turns(4))
    assert found == own
    own, found = bridged([1] * 4, turns(4))
    assert found == own


def test_a_path_through_a_gap_ends_where_the_rotations_lead():
    """The first frame is sure, those of the gap say something else, and the last cannot tell two ways apart."""
    rotations = turns(12, seed=3)
    elsewhere = Rotation.from_rotvec([0, 2.0, 0])
    own = [candidates(elsewhere * r) for r in rotations]
    own[0] = candidates(rotations[0])
    own[-1] = candidates(elsewhere * rotations[-1], rotations[-1])  # the wrong one is a little more probable
    known, times = np.zeros(12, bool), STEP * np.arange(12)
    known[[0, -1]] = True
    motions = motions_along(rotations)
    found = viterbi(Observations(bridge(own, known, motions, times, PRIOR), motions, times), PRIOR)
    off = Rotation.from_quat(found.orientations_quat_wxyz, scalar_first=True) * rotations.inv()
    np.testing.assert_allclose(off.magnitude(), 0, atol=1e-7)
    # a gap at the end: nothing but the rotations is left, and spreads say so
    own[-1], known[-1] = own[1], False
    found = viterbi(Observations(bridge(own, known, motions, times, PRIOR), motions, times), PRIOR)
    last = Rotation.from_quat(found.orientations_quat_wxyz[-1], scalar_first=True)
    assert (last * rotations[-1].inv()).magnitude() == pytest.approx(0, abs=1e-7)
    assert (np.diff(found.orientation_spreads_rad) > 0).all()
    assert (np.diff(np.linalg.norm(found.position_spreads, axis=1)) > 0).all()


def test_candidates_themselves_are_not_changed():
    start = candidates(*turns(2))
    before = replace(start, position_spreads=start.position_spreads.copy())
    predict_candidates(start, None, STEP, PRIOR)
    np.testing.assert_array_equal(start.position_spreads, before.position_spreads)
