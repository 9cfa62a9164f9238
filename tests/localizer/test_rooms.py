from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import QuantileBins, SplitConformal, conformal_quantile
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.regions import EvidenceType, RegionRules
from conformodal.localizer.rooms import NoveltyLimits, Rooms, part_of, thresholds_by_group

CELLS = QuantileBins.from_edges([np.arange(3.0)] * 2)


def rule(scores, units=None, alpha=0.25):
    return SplitConformal(CELLS, alpha, "hpd", "max").calibrate_scores(np.tile(scores[:, None], 2), units)


def belief(*positions, mass):
    n, upright = len(positions), np.array([1.0, 0, 0, 0])
    return PoseMixture.weighted(
        np.array(positions), np.ones((n, 3)), np.tile(upright, (n, 1)), np.ones(n), np.log(mass)
    )


def path(x, n=20):
    return np.column_stack((np.full(n, float(x)), np.linspace(0, 3, n), np.zeros(n)))


def test_recordings_that_come_near_each_other_are_of_one_room():
    xyz, recording = np.concatenate([path(x) for x in (0, 0.4, 20, 20.8)]), np.repeat([3, 5, 6, 9], 20)
    rooms = Rooms.of(xyz, recording, depth_m=2.0)  # near is one metre
    assert rooms.rooms.tolist() == [0] * 40 + [1] * 40
    assert Rooms.of(xyz, recording, depth_m=1.0).rooms.tolist() == [0] * 40 + [1] * 20 + [2] * 20
    assert Rooms.of(xyz, recording, depth_m=100.0) is None
    assert Rooms.of(xyz, recording, depth_m=np.nan) is None
    assert Rooms.of(xyz[:20], recording[:20], depth_m=2.0) is None


def test_two_rooms_with_a_door_between_them_stay_two():
    """One frame of the second room is in the first one, a third of whose frames are near it."""
    xyz = np.concatenate((path(0), path(5)))
    xyz[-1] = xyz[0]
    assert Rooms.of(xyz, np.repeat([0, 1], 20), depth_m=2.0).rooms.max() == 1


def test_room_is_that_of_the_likeliest_hypothesis():
    rooms = Rooms(np.concatenate((path(0), path(20))), np.repeat([0, 1], 20))
    here, there = [0.3, 1.0, 0.0], [23.0, 1.0, 0.0]
    beliefs = [belief(here, there, mass=[0.6, 0.4]), belief(here, there, mass=[0.4, 0.6]), belief(there, mass=[1e-9])]
    assert rooms.rooms_of(beliefs).tolist() == [0, 1, 1]
    assert rooms.rooms_of([]).tolist() == []


@pytest.mark.parametrize("n_members", [1, 3])
def test_the_guarantee_holds_in_each_room_with_enough_weight(n_members):
    """Each of the units is the new one once: of exchangeable units, this average is their law, without noise."""
    rng, alpha = np.random.default_rng(n_members), 0.25
    for _ in range(25):
        n_units = int(rng.integers(16, 24))
        # units are of one room mostly, and rooms differ: room 1 is harder
        rooms = (rng.random((n_units, n_members)) < rng.choice([0.1, 0.9], (n_units, 1))).astype(np.int64)
        scores = rng.random((n_units, n_members)) * (1 + rooms) + rng.random((n_units, 1))
        missed, enough = np.zeros(scores.shape, dtype=bool), np.zeros(scores.shape, dtype=bool)
        for new in range(n_units):
            others = np.delete(np.arange(n_units), new)
            units = None if n_members == 1 else np.repeat(others, n_members)
            whole, of = rule(scores[others].ravel(), units, alpha), rooms[others].ravel()
            limits = thresholds_by_group(whole, of)
            for room, limit in limits.items():
                weight, here = part_of(whole, of == room).weight, rooms[new] == room
                missed[new, here] = scores[new, here] > limit[0]
                enough[new, here] = weight >= 1 / Fraction(alpha) - 1
        for room in (0, 1):
            if enough[rooms == room].all():  # of all units the share in this room that is missed
                assert missed[rooms == room].sum() <= alpha * (rooms == room).sum() + 1e-9


def test_small_rooms_are_calibrated_together():
    """Their thresholds are at least their own quantiles."""
    easy, hard = np.linspace(0.1, 0.5, 40), np.array([0.2, 0.9])
    whole = rule(np.concatenate((easy, hard)))
    limits = thresholds_by_group(whole, np.repeat([0, 7], [40, 2]))
    np.testing.assert_allclose(limits[0], conformal_quantile(easy, 0.25), rtol=1e-9)
    np.testing.assert_allclose(limits[7], 0.9, rtol=1e-9)  # two of two are at most 3/4 of two, rounded up
    # alone, the small room weighs too little: no less than the threshold of all rooms
    low = np.concatenate((easy, hard / 10))
    limits = thresholds_by_group(rule(low), np.repeat([0, 7], [40, 2]))
    np.testing.assert_allclose(limits[7], conformal_quantile(low, 0.25), rtol=1e-9)
    # nor is it finite where nothing that it holds is; other small rooms keep the threshold of all rooms
    limits = thresholds_by_group(rule(np.concatenate((easy, [np.inf], [0.2]))), np.repeat([0, 7, 8], [40, 1, 1]))
    assert np.isfinite(limits[0]).all()
    assert np.isinf(limits[7]).all()
    np.testing.assert_allclose(limits[8], conformal_quantile(np.concatenate((easy, [np.inf, 0.2])), 0.25), rtol=1e-9)
    # two small rooms weigh enough together
    limits = thresholds_by_group(rule(np.concatenate((easy, hard / 10, hard / 9))), np.repeat([0, 7, 8], [40, 2, 2]))
    together = conformal_quantile(np.concatenate((hard / 10, hard / 9)), 0.25)
    np.testing.assert_allclose([limits[7][0], limits[8][0]], together, rtol=1e-9)


def test_many_small_rooms_do_not_cost_the_guarantee_of_all():
    """A large room and ten of two frames: each frame is the new one once, so that the average is the law."""
    rng, alpha, missed = np.random.default_rng(0), 0.25, []
    rooms = np.concatenate((np.zeros(40, dtype=np.int64), np.repeat(np.arange(1, 11), 2)))
    for _ in range(10):
        scores = rng.random(len(rooms)) + (rooms > 0)  # small rooms are harder
        for new, room in enumerate(rooms.tolist()):
            others = np.delete(np.arange(len(rooms)), new)
            missed.append(scores[new] > thresholds_by_group(rule(scores[others], alpha=alpha), rooms[others])[room][0])
    assert np.mean(missed) <= alpha + 1e-12


def test_two_targets_calibrated_apart_have_thresholds_by_room():
    cells = SplitConformal(CELLS, 0.25, "hpd", "bonferroni").calibrate_scores(np.random.default_rng(0).random((40, 2)))
    limits = thresholds_by_group(cells, np.repeat([0, 1], [38, 2]))
    assert (limits[1] >= cells.thresholds_).all()


def test_a_part_of_a_part_keeps_the_weights_in_whole_units():
    scores, units = np.arange(12) / 12, np.repeat([0, 1, 2], 4)
    half = part_of(rule(scores, units), np.tile([True, True, False, False], 3))
    quarter = part_of(half, np.tile([True, False], 3))
    assert half.weight == Fraction(3, 2)
    assert quarter.weight == Fraction(3, 4)


def test_each_type_has_thresholds_by_room():
    rng = np.random.default_rng(0)
    rooms, recognised = rng.integers(0, 2, 200), rng.random(200) < 0.5
    scores = rng.random(200) * (1 + rooms)
    rules = RegionRules(rule(scores), recognised, np.ones(200), 0.1, rooms=rooms)
    for kind, of_kind in ((EvidenceType.LANDMARKS, recognised), (EvidenceType.UNMATCHED, ~recognised)):
        for room in (0, 1):
            own = conformal_quantile(scores[of_kind & (rooms == room)], 0.25)
            limits = rules.thresholds(np.array([kind]), np.array([room]))
            np.testing.assert_allclose(limits, np.full((1, 2), own), rtol=1e-9)
        elsewhere = rules.thresholds(np.array([kind]), np.array([5]))  # no frame of it calibrates
        np.testing.assert_array_equal(elsewhere[0], rules.by_type[kind].thresholds_)
    alone = replace(rules, rooms=None)
    kinds = np.array([EvidenceType.LANDMARKS])
    np.testing.assert_array_equal(alone.thresholds(kinds, np.array([1])), alone.thresholds(kinds))
    assert (rules.thresholds(np.array([EvidenceType.UNKNOWN]), np.array([0])) == np.inf).all()


def test_motion_knows_a_recognised_place_out_of_range():
    recognised, known_p = np.array([True, True, False, False]), np.array([0.0, 0.5, 0.0, 0.5])
    rules = RegionRules(rule(np.linspace(0, 1, 4)), recognised, known_p, 0.1)
    np.testing.assert_array_equal(rules.known, [False, True, False, True])
    np.testing.assert_array_equal(rules.shows_known_place, [True, True, False, True])


def test_disturbed_images_reach_their_room_threshold():
    rng = np.random.default_rng(0)
    rooms = np.repeat([0, 1], 100)
    scores = rng.random(200) * (1 + rooms)
    copies = rule(rng.random(60))
    rules = RegionRules(rule(scores), np.ones(200, dtype=bool), np.ones(200), 0.1, copies, np.ones(60), rooms)
    kinds = np.full(2, EvidenceType.DISTURBED)
    limits = rules.thresholds(kinds, np.array([0, 1]))
    own = [rules.thresholds(np.array([EvidenceType.LANDMARKS]), np.array([room]))[0] for room in (0, 1)]
    np.testing.assert_array_equal(limits, np.maximum(own, copies.thresholds_))
    assert limits[1, 0] > limits[0, 0]


def test_unknown_places_do_not_widen_known_ones():
    """A new room of two frames of known places and two others, whose scores are infinite, beside a large room."""
    rng = np.random.default_rng(4)
    novel, rooms = np.repeat([False, True, False, True], [40, 40, 2, 2]), np.repeat([0, 1], [80, 4])
    scores = np.concatenate((rng.random(40), 2 + rng.random(40), rng.random(2), np.full(2, np.inf)))
    limits = NoveltyLimits.of(rule(scores), novel, rooms)
    asked = np.array([False, False, True, True, False, True]), np.array([0, 1, 0, 1, 5, 5])
    large, small, others, lost, elsewhere, lost_elsewhere = limits(*asked)[:, 0]
    assert large <= small < 1.1 < others < np.inf == lost
    assert elsewhere == pytest.approx(conformal_quantile(scores[~novel], 0.25))
    assert lost_elsewhere == pytest.approx(conformal_quantile(scores[novel], 0.25))
    # without calibration frames of a kind, those of all frames
    same = NoveltyLimits.of(rule(scores[:40]), novel[:40], np.zeros(40, int))
    np.testing.assert_array_equal(same(np.array([True, False]), np.zeros(2, int))[0], same.of_all)
