from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import MotionStatus, RelativeMotion, Trajectory, angle_between_quats
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.errors import ReasoningError
from conformodal.reasoning.observations import Observations, PosePath
from conformodal.reasoning.online import OnlineReasoner, online
from conformodal.reasoning.orientations import smooth_orientations
from conformodal.reasoning.prior import MotionPrior, fit_motion_prior
from conformodal.reasoning.settings import SEARCH
from conformodal.reasoning.smoother import smooth, smooth_positions
from conformodal.reasoning.viterbi import (
    backtrack,
    best_step,
    orientation_cost,
    position_cost,
    transition_cost,
    viterbi,
)

PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.5, 1.5), (0.5, 0.5))


def path(n=40):
    t = np.arange(n) * 0.1
    positions = np.column_stack((np.sin(t), 0.4 * t, 0.1 * np.cos(2 * t)))
    rotations = Rotation.from_euler("zyx", np.column_stack((0.4 * t, 0.1 * np.sin(t), 0 * t)))
    return t, positions, rotations


def exact_motions(positions, rotations):
    motions = [None]
    for t in range(1, len(positions)):
        R = rotations[t - 1].inv() * rotations[t]
        step = rotations[t - 1].inv().apply(positions[t] - positions[t - 1])
        motions.append(
            RelativeMotion(
                MotionStatus.OK,
                R.as_matrix(),
                step / np.linalg.norm(step),
                100,
                100,
                0.02,
                np.radians(0.3),
                np.radians(8),
            )
        )
    return motions


def ambiguous(positions, rotations, seed=0, period=4.0, favour=0.0):
    """Candidates at the truth and one period on either side; `favour` makes the wrong ones more probable."""
    rng = np.random.default_rng(seed)
    quats = rotations.as_quat(scalar_first=True)
    found = []
    for p, q in zip(positions, quats, strict=True):
        noisy = p + rng.normal(size=3) * 0.05
        options = noisy + np.array([[0, 0, 0], [period, 0, 0], [-period, 0, 0]])
        mass = np.log(np.repeat([0.4 - favour, 0.3 + favour, 0.3], 2) / 2)
        turned = Rotation.from_rotvec([0, 0, np.pi / 2]) * Rotation.from_quat(q, scalar_first=True)
        orientations = np.tile([-q, turned.as_quat(scalar_first=True)], (3, 1))
        order = np.argsort(-mass, kind="stable")
        places = np.repeat(options, 2, axis=0)[order]
        found.append(Candidates(places, np.full((6, 3), 0.05), orientations[order], np.full(6, 0.02), mass[order]))
    return found


def test_viterbi_is_the_best_of_all_sequences():
    t, positions, rotations = path(4)
    motions = exact_motions(positions, rotations)
    candidates = ambiguous(positions, rotations, favour=0.05)
    found = viterbi(Observations(candidates, motions, t), PRIOR)

    def total(sequence):
        score = candidates[0].log_mass[sequence[0]]
        for s in range(1, 4):
            cost = transition_cost(candidates[s - 1], candidates[s], motions[s], 0.1, PRIOR)
            score += candidates[s].log_mass[sequence[s]] - cost[sequence[s - 1], sequence[s]]
        return score

    best = max(product(range(6), repeat=4), key=total)
    np.testing.assert_array_equal(found.positions_xyz, PosePath.choose(candidates, t, best).positions_xyz)


def two_rooms(vague_m):
    """Ten frames at 0; from the fifth on 5 m away is likelier by 2 nats a frame, and the fifth may be anywhere."""
    facing, turn = np.array([[1.0, 0, 0, 0]] * 3), np.full(3, 0.02)
    places, spreads = np.zeros((2, 3)), np.full((2, 3), 0.05)
    places[1, 0] = 5
    early = Candidates(places, spreads, facing[:2], turn[:2], np.array([0.0, -9.0]))
    late = replace(early, log_mass=np.array([-2.0, 0.0]))
    anywhere = np.concatenate((spreads, np.full((1, 3), vague_m)))
    between = Candidates(np.vstack((places, [2.5, 0, 0])), anywhere, facing, turn, np.array([-2.0, -2.0, 0.0]))
    candidates = [*[early] * 4, between, *[late] * 5]
    return Observations(candidates, [None] * 10, np.arange(10) * 0.1)


@pytest.mark.parametrize("vague_m", [1.0, 3.0, 100.0])
def test_a_vague_candidate_is_no_bridge_between_places_out_of_reach(vague_m):
    seen = two_rooms(vague_m)
    still = replace(PRIOR, top_speed_mps=(0.2, 0.2))
    for found in (viterbi(seen, still), online(seen, still, 9)):
        assert (np.delete(found.positions_xyz[:, 0], 4) == 0).all()
    # where a camera is quick enough for the way, it may well have gone
    quick = replace(PRIOR, top_speed_mps=(40.0, 40.0))
    assert (viterbi(seen, quick).positions_xyz[5:, 0] == 5).all()


def test_viterbi_mends_a_wrong_start():
    t, positions, rotations = path()
    candidates = ambiguous(positions, rotations)
    candidates[0] = replace(candidates[0], log_mass=np.log([0.1, 0.1, 0.3, 0.3, 0.1, 0.1]))
    motions = exact_motions(positions, rotations)
    motions[20] = None  # blind for a moment
    found = viterbi(Observations(candidates, motions, t), PRIOR)
    assert np.linalg.norm(found.positions_xyz - positions, axis=1).max() < 0.5
    quats = found.orientations_quat_wxyz
    assert angle_between_quats(quats, rotations.as_quat(scalar_first=True)).max() < 0.01


def test_costs_are_bounded_and_smallest_at_the_truth():
    _, positions, rotations = path(2)
    before, after = ambiguous(positions, rotations)
    motion = exact_motions(positions, rotations)[1]
    cost = transition_cost(before, after, motion, 0.1, PRIOR)
    apart = orientation_cost(before, after, motion, 0.1, PRIOR) + position_cost(before, after, 0.1, PRIOR)
    np.testing.assert_array_equal(cost, np.minimum(apart, SEARCH.followed_jump))
    assert (np.diag(cost)[::2] < 5).all()  # true headings; odd ones are turned, and so is where they led
    assert cost[0, 2] == cost[2, 0] == SEARCH.followed_jump
    assert cost[0, 1] >= SEARCH.rotation_outlier
    unseen = transition_cost(before, after, RelativeMotion(MotionStatus.LOST), 0.1, PRIOR)
    assert unseen[0, 2] == unseen[2, 0] == SEARCH.jump  # nothing was followed


def half_turned(n_vague=0, seed=0):
    """A flight from a known pose to frames that may as well be its half-turn, which is likelier in each of them.

    The camera looks sideways and is known to turn no faster than by a right angle a second; frames are two seconds
    apart. The first `n_vague` of the others may be anywhere and face anywhere.
    """
    rng = np.random.default_rng(seed)
    yaw = np.array([90.0, 0.0, 40.0, -40.0, 0.0])
    rotations = Rotation.from_euler("z", yaw[:, None], degrees=True)
    positions = np.array([[0, 0, 0], [3, 0, 0], [3.5, 0.4, 0], [3.5, -0.4, 0], [3, 0, 0.0]])
    half = Rotation.from_euler("z", 180, degrees=True)
    found = []
    for k, (p, r) in enumerate(zip(positions, rotations, strict=True)):
        pairs = [(p, r)] if k == 0 else [(half.apply(p), half * r), (p, r), (half.apply(p), r), (p, half * r)]
        places = np.array([p for p, _ in pairs]) + rng.normal(size=3) * 0.02
        mass = np.log([0.5, 0.3, 0.1, 0.1][: len(pairs)])
        quats = np.array([r.as_quat(scalar_first=True) for _, r in pairs])
        spread, turn = (5.0, 2.0) if 0 < k <= n_vague else (0.05, 0.02)
        found.append(Candidates(places, np.full((len(pairs), 3), spread), quats, np.full(len(pairs), turn), mass))
    motions = exact_motions(positions, rotations)
    blind = [m and replace(m, direction_prev=None, direction_sigma_rad=np.inf) for m in motions]
    return positions, Observations(found, blind, 2.0 * np.arange(5))


@pytest.mark.parametrize("reasoner", [viterbi, online])
@pytest.mark.parametrize("n_vague", [0, 1, 2])
def test_a_relative_rotation_chooses_between_places_that_look_alike_after_a_half_turn(reasoner, n_vague):
    positions, seen = half_turned(n_vague)
    quick = replace(PRIOR, turn_rate_rad_s=np.pi / 2, top_speed_mps=(3.0, 3.0))
    found = reasoner(seen, quick).positions_xyz
    np.testing.assert_allclose(found[n_vague + 1 :], positions[n_vague + 1 :], atol=0.2)
    still = replace(seen, motions=[None] * 5)
    assert (reasoner(still, quick).positions_xyz[n_vague + 1 :, 0] < 0).all()  # the likelier side, not the right one


def test_the_way_back_is_the_best_of_all_sequences():
    rng = np.random.default_rng(0)
    first, unaries = rng.normal(size=3), rng.normal(size=(4, 3))
    transitions = rng.normal(size=(4, 3, 3))
    score, backs = first, [np.zeros(3, dtype=np.int64)]
    for transition, unary in zip(transitions, unaries, strict=True):
        score, origin = best_step(score, transition, unary)
        backs.append(origin)

    def total(sequence):
        steps = zip(sequence, sequence[1:], transitions, unaries, strict=False)
        return first[sequence[0]] + sum(transition[a, b] + unary[b] for a, b, transition, unary in steps)

    best = max(product(range(3), repeat=5), key=total)
    np.testing.assert_array_equal(backtrack(backs, int(np.argmax(score))), best)
    assert score.max() == 0  # so that long sequences do not run out of digits


def test_observations_that_do_not_belong_together_are_refused():
    t, positions, rotations = path(3)
    candidates = ambiguous(positions, rotations)
    with pytest.raises(ReasoningError, match="1 motions"):
        Observations(candidates, [None], t)
    with pytest.raises(ReasoningError, match="0 candidates"):
        Observations([], [], t[:0])
    with pytest.raises(ReasoningError, match=r"increase.*frames 1, 2"):
        Observations(candidates, [None] * 3, t[[0, 1, 1]])


def test_smoothing_improves_on_noise():
    rng = np.random.default_rng(1)
    t, positions, rotations = path(200)
    motions = exact_motions(positions, rotations)
    motions[50] = None
    truth = Trajectory(t, positions, rotations.as_quat(scalar_first=True))
    noisy_q = (Rotation.from_rotvec(rng.normal(size=(200, 3)) * 0.03) * rotations).as_quat(scalar_first=True)
    noisy_p = positions + rng.normal(size=(200, 3)) * 0.1
    noisy_p[100] += 3  # one wrong mode
    q = smooth_orientations(noisy_q, np.full(200, 0.03), motions, t, PRIOR)
    p = smooth_positions(noisy_p, np.full((200, 3), 0.1), q, t, PRIOR)

    def rms(x):
        return np.sqrt(np.mean(x**2))

    before_q = angle_between_quats(noisy_q, truth.orientations_quat_wxyz)
    assert rms(angle_between_quats(q, truth.orientations_quat_wxyz)) < 0.4 * rms(before_q)
    error = np.linalg.norm(p - positions, axis=1)
    assert rms(error) < 0.09  # 0.17 before, without the outlier
    assert error[100] < 0.4


def test_smoothing_keeps_what_is_exact_and_short():
    t, positions, rotations = path(30)
    quats = rotations.as_quat(scalar_first=True)
    motions = exact_motions(positions, rotations)
    same = smooth_orientations(quats, np.full(30, 0.02), motions, t, PRIOR)
    np.testing.assert_allclose(angle_between_quats(same, quats), 0, atol=1e-6)
    assert smooth_orientations(quats[:1], np.ones(1), motions[:1], t[:1], PRIOR).shape == (1, 4)
    assert smooth_positions(positions[:2], np.ones((2, 3)), quats[:2], t[:2], PRIOR).shape == (2, 3)
    with pytest.raises(ReasoningError, match="positive"):
        smooth_positions(positions, np.zeros((30, 3)), quats, t, PRIOR)


def test_a_fine_answer_is_not_given_up_for_missing_its_claim_a_wrong_one_is():
    t, positions, rotations = path(60)
    quats = rotations.as_quat(scalar_first=True)
    calm = replace(PRIOR, acceleration_density=(0.005, 0.005))
    off, spreads = positions.copy(), np.full((60, 3), 0.001)
    off[20, 0] += 0.02  # a jerk: twenty times the claim, but little beside a depth of two metres
    off[40, 0] += 0.5
    found, blind = (smooth_positions(off, spreads, quats, t, prior) for prior in (replace(calm, depth_m=2.0), calm))
    assert blind[20, 0] - positions[20, 0] < 0.01 < 0.015 < found[20, 0] - positions[20, 0]
    assert abs(found[40, 0] - positions[40, 0]) < 0.01


def test_a_path_is_smoothed_orientations_first():
    rng = np.random.default_rng(2)
    t, positions, rotations = path(50)
    motions = exact_motions(positions, rotations)
    seen = Observations(ambiguous(positions, rotations), motions, t)
    quats = (Rotation.from_rotvec(rng.normal(size=(50, 3)) * 0.03) * rotations).as_quat(scalar_first=True)
    own = PosePath(t, positions + rng.normal(size=(50, 3)) * 0.1, np.full((50, 3), 0.1), quats, np.full(50, 0.03))
    found = smooth(own, seen, PRIOR)
    turned = smooth_orientations(quats, own.orientation_spreads_rad, motions, t, PRIOR)
    np.testing.assert_array_equal(found.orientations_quat_wxyz, turned)
    moved = smooth_positions(own.positions_xyz, own.position_spreads, turned, t, PRIOR)
    np.testing.assert_array_equal(found.positions_xyz, moved)


def test_prior_learns_speeds_and_turns():
    t = np.arange(400) * 0.1
    circle = np.column_stack((2 * np.cos(0.5 * t), 2 * np.sin(0.5 * t), 0 * t))
    quats = Rotation.from_rotvec(np.column_stack((0 * t, 0 * t, 0.5 * t))).as_quat(scalar_first=True)
    prior = fit_motion_prior(Trajectory(t, circle, quats), np.zeros(400, int))
    assert prior.turn_rate_rad_s == pytest.approx(0.5, rel=0.01)
    assert prior.reach_m(0.1) == pytest.approx(0.11, rel=0.01)  # 1 m/s and a tenth more
    assert (np.diff(prior.intervals_s) > 0).all()
    with pytest.raises(ReasoningError, match="three frames"):
        fit_motion_prior(Trajectory(t[:2], circle[:2], quats[:2]), np.zeros(2, int))


@pytest.mark.parametrize("seed", range(4))
def test_the_online_path_with_a_long_lag_is_that_of_the_whole_search(seed):
    t, positions, rotations = path(30)
    motions = exact_motions(positions, rotations)
    motions[12] = None
    candidates = ambiguous(positions, rotations, seed=seed, favour=0.05)
    for k in (5, 6, 13):
        candidates[k] = replace(candidates[k], position_spreads=np.full((6, 3), 2.0))
    seen = Observations(candidates, motions, t)
    whole = viterbi(seen, PRIOR)
    for lag in (29, 50):
        found = online(seen, PRIOR, lag)
        np.testing.assert_array_equal(found.timestamps_s, t)
        np.testing.assert_array_equal(found.positions_xyz, whole.positions_xyz)
        np.testing.assert_array_equal(found.orientations_quat_wxyz, whole.orientations_quat_wxyz)


@pytest.mark.parametrize("lag", [0, 1, 7, 39, 40])
def test_online_keeps_what_the_stream_last_said_of_every_frame(lag):
    t, positions, rotations = path(40)
    motions = exact_motions(positions, rotations)
    candidates = ambiguous(positions, rotations, favour=0.2)
    reasoner = OnlineReasoner(PRIOR, lag)
    said = {}
    for c, m, s in zip(candidates, motions, t, strict=True):
        revised = reasoner.push(c, m, s)
        said |= dict(zip(revised.timestamps_s, revised.positions_xyz, strict=True))
    found = online(Observations(candidates, motions, t), PRIOR, lag)
    np.testing.assert_array_equal(found.positions_xyz, [said[s] for s in t])


def test_online_answers_are_revised_within_the_lag_and_memory_does_not_grow():
    t, positions, rotations = path(60)
    motions = exact_motions(positions, rotations)
    candidates = ambiguous(positions, rotations)
    wrong = candidates[0].positions_xyz[2]
    # the first frame favours a place one period off
    candidates[0].log_mass[:] = np.log([0.05, 0.05, 0.6, 0.2, 0.05, 0.05])
    reasoner = OnlineReasoner(PRIOR, lag=10)
    first = reasoner.push(candidates[0], None, t[0])
    np.testing.assert_array_equal(first.positions_xyz[0], wrong)
    for i in range(1, 60):
        revision = reasoner.push(candidates[i], motions[i], t[i])
        assert len(revision.timestamps_s) == min(i + 1, 11)
        assert revision.timestamps_s[-1] == t[i]
        if i == 10:
            assert np.linalg.norm(revision.positions_xyz[0] - positions[0]) < 0.5  # the start, mended
    assert len(reasoner._frames) == 11
    now = OnlineReasoner(PRIOR, lag=0)
    whole = OnlineReasoner(PRIOR, lag=59)
    for c, m, s in zip(candidates, motions, t, strict=True):
        a, b = now.push(c, m, s), whole.push(c, m, s)
        assert a.positions_xyz.shape == (1, 3)
        np.testing.assert_array_equal(a.positions_xyz[0], b.positions_xyz[-1])


def test_online_errors():
    with pytest.raises(ReasoningError, match="lag"):
        OnlineReasoner(PRIOR, -1)
    _, positions, rotations = path(2)
    reasoner = OnlineReasoner(PRIOR)
    first, second = ambiguous(positions, rotations)
    reasoner.push(first, None, 1.0)
    with pytest.raises(ReasoningError, match="increase"):
        reasoner.push(second, None, 1.0)
