"""The filter beside independent oracles: Kalman's formulas, and enumeration of all sequences."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from conformodal.geometry import angle_between_quats
from conformodal.localizer.filter import ALIKE, PoseFilter, filter_posteriors, hindsight_posteriors, predict, update
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import Observations, Posterior, choose_places, find_places
from tests.localizer.flights import PRIOR, ambiguous, exact_motions, path

FACING = np.array([1.0, 0, 0, 0])


def hypotheses(x, mass, spread=0.05, turn=0.02, quats=FACING):
    """At x metres along the first axis, with these probabilities."""
    n = len(x)
    places = np.column_stack((x, np.zeros((n, 2))))
    spreads = np.broadcast_to(np.asarray(spread, dtype=float).reshape(-1, 1), (n, 3)).copy()
    turns = np.broadcast_to(np.asarray(turn, dtype=float), n).copy()
    return PoseMixture.weighted(places, spreads, np.broadcast_to(quats, (n, 4)).copy(), turns, np.log(mass))


def same(one, other):
    np.testing.assert_array_equal(one.hypotheses.positions_xyz, other.hypotheses.positions_xyz)
    np.testing.assert_array_equal(one.hypotheses.log_weights, other.hypotheses.log_weights)
    assert one.elsewhere == other.elsewhere


def test_single_hypothesis_follows_a_kalman_update():
    """It is only as sharp as the sharper of prediction and measurement."""
    before, seen = hypotheses([0.0], [1.0], spread=0.3), hypotheses([0.1], [1.0], spread=0.2)
    ahead = replace(predict(Posterior(before, 0.0), None, 0.2, PRIOR), elsewhere=1e-300)
    found = update(ahead, seen, PRIOR, wrong=1e-300, tempering=1.0).hypotheses
    variance = 0.3**2 + (1.5 * 0.2) ** 2 / 5  # of a ball of that radius, per axis
    gain = variance / (variance + 0.2**2)
    np.testing.assert_allclose(found.positions_xyz, [[gain * 0.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.position_spreads, [[0.2] * 3])
    np.testing.assert_allclose(found.orientation_spreads_rad, 0.02)


def test_a_measured_rotation_turns_hypotheses():
    _, positions, rotations = path(2)
    motion = exact_motions(positions, rotations)[1]
    still = rotations[0].as_quat(scalar_first=True)
    before = Posterior(hypotheses([0.0], [1.0], turn=0.001, quats=still), 0.0)
    ahead = predict(before, motion, 0.1, PRIOR)
    turned = rotations.as_quat(scalar_first=True)
    assert angle_between_quats(ahead.hypotheses.orientations_quat_wxyz[0], turned[1]) < 1e-6
    back = predict(Posterior(ahead.hypotheses, 0.0), motion, 0.1, PRIOR, back=True)
    assert angle_between_quats(back.hypotheses.orientations_quat_wxyz[0], turned[0]) < 1e-6
    seen = hypotheses([0.0, 0.0], [0.5, 0.5], turn=0.001, quats=np.array([still, turned[1]]))
    found = find_places(update(ahead, seen, PRIOR, wrong=1e-9, tempering=1.0), PRIOR)[0]
    assert angle_between_quats(found.orientation_quat_wxyz, turned[1]) < 0.005  # the measured turn is the likelier one


WIDE = replace(PRIOR, volume_m3=1e6)


def transition(before, after, step_s):
    """Densities of positions and orientations by SciPy, relative to an even spread."""
    found = np.empty((len(before.log_weights), len(after.log_weights)))
    for (j, p), (k, q) in product(enumerate(before.positions_xyz), enumerate(after.positions_xyz)):
        v = before.position_spreads[j] ** 2 + after.position_spreads[k] ** 2 + WIDE.reach_m(step_s) ** 2 / 5
        a = before.orientation_spreads_rad[j] ** 2 + after.orientation_spreads_rad[k] ** 2
        a += (WIDE.turn_rate_rad_s * step_s) ** 2
        turned = multivariate_normal(np.zeros(3), a * np.eye(3)).pdf(np.zeros(3))
        found[j, k] = multivariate_normal(p, np.diag(v)).pdf(q) * turned * WIDE.volume_m3 * 8 * np.pi**2
    return found


def test_probabilities_are_those_of_all_sequences_together(monkeypatch):
    # sharp hypotheses, out of each other's reach within a place but for steps that take long
    for name, value in {"ALIKE": 0.0, "_SHARPNESS": 1.0, "_WRONG": 1e-12, "_JUMP": 1e-12}.items():
        monkeypatch.setattr(f"conformodal.localizer.filter.{name}", value)
    rng = np.random.default_rng(0)
    frames = [hypotheses(np.array([0.0, 3.0, 7.0]) + rng.normal(size=3), m, 1e-3) for m in rng.dirichlet(np.ones(3), 3)]
    seen = Observations(frames, [None] * 3, np.array([0.0, 3.0, 5.0]))
    steps = [transition(frames[0], frames[1], 3.0), transition(frames[1], frames[2], 2.0)]
    joint = np.zeros((3, 3, 3))
    for a, b, c in product(range(3), repeat=3):
        masses = [np.exp(f.log_weights[k]) for f, k in zip(frames, (a, b, c), strict=True)]
        joint[a, b, c] = np.prod(masses) * steps[0][a, b] * steps[1][b, c]
    joint /= joint.sum()
    expected = [joint.sum(axis=(1, 2)), joint.sum(axis=(0, 2)), joint.sum(axis=(0, 1))]
    for frame, posterior, mass in zip(frames, hindsight_posteriors(seen, WIDE), expected, strict=True):
        places = [p for p in find_places(posterior, WIDE) if p.probability > 1e-5]
        order = np.argsort(-mass)
        np.testing.assert_allclose([p.probability for p in places], mass[order], rtol=2e-3)
        np.testing.assert_allclose([p.position_xyz for p in places], frame.positions_xyz[order], atol=0.01)
    first_two = np.einsum("a,ab,b->b", np.exp(frames[0].log_weights), steps[0], np.exp(frames[1].log_weights))
    found = find_places(filter_posteriors(seen, WIDE)[1], WIDE)
    np.testing.assert_allclose([p.probability for p in found], np.sort(first_two / first_two.sum())[::-1], rtol=2e-3)


def test_images_that_follow_each_other_closely_say_less_together():
    """Ten images that speak for one of two places, 3 to 2: within a second, and within ten minutes."""
    told = hypotheses([0.0, 5.0], [0.6, 0.4])
    odds, still = {}, replace(PRIOR, top_speed_mps=(0.0, 0.0))
    for step_s in (1e-4, 0.1, 60.0):
        seen = Observations([told] * 10, [None] * 10, np.arange(10) * step_s)
        last = find_places(filter_posteriors(seen, still)[-1], still)
        odds[step_s] = last[0].probability / last[1].probability
        in_hindsight = [find_places(its, still) for its in hindsight_posteriors(seen, still)]
        for k in (0, 4):  # all ten images speak for each frame, and each counts once
            assert in_hindsight[k][0].probability / in_hindsight[k][1].probability == pytest.approx(
                odds[step_s], rel=0.1
            )
    share = 1 - ALIKE
    assert odds[1e-4] == pytest.approx(1.5 ** (1 + 9 * share), rel=0.05)
    assert odds[1e-4] < 0.6 * odds[0.1] < odds[0.1] < 0.5 * odds[60.0]
    assert odds[60.0] == pytest.approx(1.5**10, rel=0.05)


@pytest.mark.parametrize("vague_m", [1.0, 3.0, 100.0])
def test_a_vague_hypothesis_does_not_link_places_out_of_reach(vague_m):
    """From the fifth frame on, 5 m away is likelier by two nats per frame, and the fifth may be anywhere."""
    early, late = hypotheses([0.0, 5.0], np.exp([0.0, -9.0])), hypotheses([0.0, 5.0], np.exp([-2.0, 0.0]))
    between = hypotheses([0.0, 5.0, 2.5], np.exp([-2.0, -2.0, 0.0]), spread=[0.05, 0.05, vague_m])
    seen = Observations([*[early] * 4, between, *[late] * 5], [None] * 10, np.arange(10) * 0.1)
    still = replace(PRIOR, top_speed_mps=(0.2, 0.2), volume_m3=100.0)
    x = choose_places(hindsight_posteriors(seen, still), seen.timestamps_s, still).positions_xyz[:, 0]
    assert (np.abs(np.delete(x, 4)) < 0.1).all()
    quick = replace(PRIOR, top_speed_mps=(40.0, 40.0), volume_m3=100.0)
    x = choose_places(hindsight_posteriors(seen, quick), seen.timestamps_s, quick).positions_xyz[:, 0]
    assert (np.abs(x[5:] - 5) < 0.1).all()


def test_images_of_unknown_places_do_not_move_the_path():
    x = np.linspace(0, 1, 11)
    frames = [hypotheses([here], [1.0]) for here in x]
    wrong = np.isin(np.arange(11), (0, 4, 5, 6))  # the first, and three in a row, point elsewhere
    for k in np.flatnonzero(wrong):
        frames[k] = hypotheses([here + 30 for here in x[k : k + 1]], [1.0], spread=0.01)
    seen = Observations(frames, [None] * 11, 0.1 * np.arange(11), known=~wrong)
    prior = replace(PRIOR, volume_m3=1000.0)
    found = choose_places(hindsight_posteriors(seen, prior), seen.timestamps_s, prior)
    assert np.abs(found.positions_xyz[:, 0] - x).max() < 0.2
    assert found.position_spreads[5, 0] > found.position_spreads[9, 0]  # bridged by motion alone


def test_a_stream_is_lost_until_it_shows_a_known_place():
    frames = [hypotheses([0.0, 4.0], [0.5, 0.5]), *[hypotheses([0.0], [1.0])] * 4]
    known = np.array([False, False, False, True, True])
    seen = Observations(frames, [None] * 5, 0.1 * np.arange(5), known=known)
    prior = replace(PRIOR, volume_m3=1000.0)
    assert [its.lost for its in filter_posteriors(seen, prior)] == [True, True, True, False, False]
    assert not any(its.lost for its in hindsight_posteriors(seen, prior))  # what follows leads back


def test_posteriors_know_how_far_the_nearest_known_place_is():
    known = np.array([0, 1, 0, 0, 0, 1, 0], dtype=bool)
    seen = Observations([hypotheses([0.0], [1.0])] * 7, [None] * 7, 0.1 * np.arange(7), known=known)
    prior = replace(PRIOR, volume_m3=1000.0)
    forward = [its.unseen_s for its in filter_posteriors(seen, prior)]
    np.testing.assert_allclose(forward[1:], [0, 0.1, 0.2, 0.3, 0, 0.1])
    both = [its.unseen_s for its in hindsight_posteriors(seen, prior)]
    np.testing.assert_allclose(both, [0.1, 0, 0.1, 0.2, 0.1, 0, 0.1])
    nowhere = hindsight_posteriors(replace(seen, known=np.zeros(7, dtype=bool)), prior)
    assert all(its.lost or its.unseen_s == np.inf for its in nowhere[:-1])


def half_turned(seed=0):
    """A flight from a known pose to frames that may as well be its half-turn, which is likelier in each of them."""
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
        found.append(
            PoseMixture.weighted(places, np.full((len(pairs), 3), 0.05), quats, np.full(len(pairs), 0.02), mass)
        )
    motions = exact_motions(positions, rotations)
    return positions, Observations(found, motions, 2.0 * np.arange(5))


@pytest.mark.parametrize("reasoner", [filter_posteriors, hindsight_posteriors])
def test_relative_rotation_resolves_half_turn_ambiguity(reasoner):
    positions, seen = half_turned()
    quick = replace(PRIOR, turn_rate_rad_s=np.pi / 2, top_speed_mps=(3.0, 3.0), volume_m3=100.0)
    found = choose_places(reasoner(seen, quick), seen.timestamps_s, quick).positions_xyz
    np.testing.assert_allclose(found, positions, atol=0.2)
    still = replace(seen, motions=[None] * 5)
    found = choose_places(reasoner(still, quick), seen.timestamps_s, quick).positions_xyz
    assert (found[1:, 0] < 0).all()  # the likelier side, not the right one


def test_long_lag_gives_whole_recording_posteriors():
    t, positions, rotations = path(30)
    motions = exact_motions(positions, rotations)
    motions[12] = None
    seen = Observations(ambiguous(positions, rotations, favour=0.05), motions, t)
    stream, short = PoseFilter(PRIOR, lag=40), PoseFilter(PRIOR, lag=5)
    forward = filter_posteriors(seen, PRIOR)
    for k, (c, m, s) in enumerate(zip(seen.candidates, motions, t, strict=True)):
        for pose_filter in (stream, short):
            same(pose_filter.push(c, m, float(s)), forward[k])
        window = short.window()
        assert window.seen.timestamps_s.tolist() == t[max(0, k - 5) : k + 1].tolist()
        same(hindsight_posteriors(window.seen, PRIOR, window.forward)[-1], forward[k])
    whole, window = hindsight_posteriors(seen, PRIOR), stream.window()
    for found, expected in zip(hindsight_posteriors(window.seen, PRIOR, window.forward), whole, strict=True):
        same(found, expected)
