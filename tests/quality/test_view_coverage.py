"""Gaps that were cut by hand are found where they were cut, and where nothing is missing nothing is reported."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import Trajectory
from conformodal.quality.advice import Names, describe_quality, record_next
from conformodal.quality.view_coverage import pose_coverage
from conformodal.quality.views import KnownViews, ViewScale, stations

SCALE = ViewScale(depth_m=2.0, fov_rad=1.5)  # thin from 0.15 rad or 0.3 m on
N = 120
EVERY = np.arange(N)
ONE = np.zeros(N, dtype=np.int64)


def path(positions=None, turns=None):
    n = len(positions if positions is not None else turns)
    positions = np.zeros((n, 3)) if positions is None else np.asarray(positions, dtype=float)
    turns = Rotation.identity(n) if turns is None else turns
    return Trajectory(np.arange(n) / 10, positions, turns.as_quat(scalar_first=True))


def corridor(step=0.04):
    return path(np.column_stack((step * EVERY, np.zeros(N), np.zeros(N))))


def about(axis, angles):
    return Rotation.from_rotvec(np.outer(angles, np.eye(3)["xyz".index(axis)]))


def yaw(angles):
    """A standing camera that turns to the right, about the axis that points down."""
    return path(turns=about("y", angles))


def quality(poses, known, recording=ONE):
    coverage = pose_coverage(poses, recording[: len(poses)], known, SCALE)
    every = np.arange(len(poses))
    found = SimpleNamespace(
        posed=every,
        poses=poses,
        known=np.isin(poses.timestamps_s, known.timestamps_s),
        known_names=every,
        coverage=coverage,
        ambiguity=None,
        guarantees=[],
        errors_m=None,
        scale=SCALE,
    )
    sequence = SimpleNamespace(recording=recording[: len(poses)])
    return found, record_next(found, Names(sequence, poses.positions_xyz))


def test_frames_that_are_not_known_are_thin_where_the_nearest_known_one_is_far():
    poses = corridor()
    known = poses[(EVERY < 50) | (EVERY >= 70)]
    found, advice = quality(poses, known)
    # 0.04 m a frame: eight frames or more from 49 and from 70 are more than 0.3 m
    assert np.flatnonzero(found.coverage.sparse_frames).tolist() == [57, 58, 59, 60, 61, 62]
    (one,) = found.coverage.sparse
    assert (one.first, one.last, one.between) == (57, 62, False)
    assert one.distance_m == pytest.approx(0.4, abs=0.02)
    assert one.place_xyz[0] == pytest.approx(59.5 * 0.04, abs=0.03)
    assert found.coverage.fast == []
    assert len(advice) == 1
    assert "frames 57 to 62 (around x=2.4, y=0.0)" in advice[0]
    assert "0.40 m and 0 degrees" in advice[0]


def test_only_frames_that_the_model_was_not_trained_on_are_counted_as_sparsely_covered():
    poses = corridor()
    unknown = (EVERY >= 50) & (EVERY < 70)
    said = describe_quality(quality(poses, poses[~unknown])[0])[0]
    assert "6 of 20 frames" in said
    # a check without a model takes all frames as known: it must not say that none of them is sparsely covered
    assert "covered" not in describe_quality(quality(poses, poses)[0])[0]


def test_a_piece_cut_out_of_a_recording_is_a_gap():
    whole = corridor()
    cut = whole[(EVERY < 50) | (EVERY >= 70)]
    found, advice = quality(cut, cut)
    assert not found.coverage.sparse_frames.any()
    (one,) = found.coverage.sparse
    assert (one.first, one.last, one.between) == (49, 50, True)
    assert one.distance_m == pytest.approx(21 * 0.04 / 2)
    assert found.coverage.fast == []  # the gap is said once
    assert "along frames 49 to 50" in advice[0]


def test_a_gap_that_another_recording_fills_is_none():
    whole = corridor()
    cut = (EVERY < 50) | (EVERY >= 70)
    found, advice = quality(whole[cut], whole)
    assert found.coverage.sparse == []
    assert all("more slowly" in line for line in advice)


@pytest.mark.parametrize("poses", [corridor(), yaw(EVERY * 0.02), path(np.zeros((N, 3)))], ids=["way", "turn", "still"])
def test_where_nothing_is_missing_nothing_is_reported(poses):
    found, advice = quality(poses, poses)
    assert found.coverage.sparse == []
    assert found.coverage.fast == []
    assert advice == []
    said = describe_quality(found)[0]
    assert "no gap between the 120 frames" in said
    assert "10 % of the field of view, 8.6 degrees or 0.30 m" in said


def test_between_two_recordings_nothing_is_missing():
    poses = path(np.column_stack((np.where(EVERY < 60, 0, 50) + 0.04 * EVERY, ONE, ONE)))
    found, _ = quality(poses, poses, recording=(EVERY >= 60).astype(np.int64))
    assert found.coverage.sparse == []
    found, _ = quality(poses, poses)
    assert [(one.first, one.last) for one in found.coverage.sparse] == [(59, 60)]


@pytest.mark.parametrize(("sign", "side"), [(1, "right"), (-1, "left")])
def test_turns_that_are_missing_are_named_by_their_side(sign, side):
    angles = sign * 0.02 * EVERY
    found, advice = quality(yaw(angles), yaw(angles)[:60])
    (one,) = found.coverage.sparse
    # frame 59 is the last that is known; 0.16 rad are more than 0.15
    assert (one.first, one.last) == (67, 119)
    assert one.angle_deg == pytest.approx(np.degrees(60 * 0.02), rel=0.02)
    assert f"(known frame 59; from there the camera is turned {side})" in advice[0]


@pytest.mark.parametrize(("sign", "side"), [(1, "down"), (-1, "up")])
def test_pitch_and_ways_are_named_in_the_cameras_frame(sign, side):
    # about the axis that points right, positive turns look up: y points down
    level = about("x", -sign * 0.02 * EVERY)
    found, advice = quality(path(turns=level), path(turns=level)[:60])
    assert found.coverage.sparse[0].turned == side
    ways = np.zeros((N, 3))
    ways[:, 2] = sign * 0.04 * EVERY
    found, advice = quality(path(ways), path(ways)[:60])
    assert found.coverage.sparse[0].turned == ""
    assert f"(known frame 59; from there the camera is moved {'forward' if sign > 0 else 'back'})" in advice[0]


def test_neighbouring_gaps_are_one_way_that_needs_more_frames():
    rates = np.where((EVERY >= 40) & (EVERY < 45), 0.4, 0.02)
    poses = yaw(np.concatenate(([0.0], np.cumsum(rates)))[:N])
    found, advice = quality(poses, poses)
    (one,) = found.coverage.sparse
    assert (one.first, one.last, one.between) == (40, 45, True)
    assert one.angle_deg == pytest.approx(np.degrees(0.2), abs=0.01)
    assert found.coverage.fast == []
    assert "Record more views along frames 40 to 45 (around x=0.0, y=0.0): on the way, the nearest" in advice[0]


def test_fast_turns_are_found_where_they_are():
    rates = np.where((EVERY >= 40) & (EVERY < 45), 0.24, 0.02)
    poses = yaw(np.concatenate(([0.0], np.cumsum(rates)))[:N])
    found, advice = quality(poses, poses)
    assert found.coverage.sparse == []
    (one,) = found.coverage.fast
    assert (one.first, one.last, one.turning) == (40, 45, True)
    assert one.angle_deg == pytest.approx(np.degrees(0.24))
    assert advice == [
        "Turn more slowly in frames 40 to 45 (around x=0.0, y=0.0): up to 0.00 m and 14 degrees per frame."
    ]


def test_the_nearest_view_is_the_one_that_a_search_through_all_finds():
    rng = np.random.default_rng(0)
    known = path(rng.uniform(0, 3, (300, 3)), Rotation.random(300, random_state=1))
    turns = Rotation.from_quat(known.orientations_quat_wxyz, scalar_first=True)
    near = Rotation.from_rotvec(rng.normal(0, 0.1, (300, 3))) * turns
    views = path(known.positions_xyz + rng.normal(0, 0.1, (300, 3)), near)
    flipped = Trajectory(views.timestamps_s, views.positions_xyz, -views.orientations_quat_wxyz)
    away = [np.linalg.norm(view - known.positions_xyz, axis=1) / 2 for view in views.positions_xyz]
    angle = np.array([(one.inv() * turns).magnitude() for one in near])
    expected = np.hypot(away, angle).min(axis=1) / SCALE.fov_rad
    for asked in (views, flipped):
        np.testing.assert_allclose(KnownViews(known, SCALE).nearest(asked).change, expected, rtol=0.01)


def test_stations_lie_on_the_way():
    poses = path([[0, 0, 0], [1, 0, 0]], about("y", [0, 0.4]))
    way = stations(poses, np.zeros(2, dtype=np.int64), SCALE)
    share = way.at
    assert len(share) == 1 + 10  # 0.64 rad in an even number of steps of 0.075 at most
    assert 0.5 in share
    np.testing.assert_allclose(way.views.positions_xyz[:, 0], share)
    turned = Rotation.from_quat(way.views.orientations_quat_wxyz, scalar_first=True).as_euler("yxz")[:, 0]
    np.testing.assert_allclose(turned, 0.4 * share, atol=1e-12)


def test_a_camera_that_turns_about_its_line_of_sight_is_tilted():
    rolled = path(turns=about("z", 0.02 * EVERY))
    found, advice = quality(rolled, rolled[:60])
    assert found.coverage.sparse[0].turned == "tilted"
    assert "(known frame 59; from there the camera is tilted)" in advice[0]


def test_without_a_known_frame_all_is_to_be_recorded():
    poses = corridor()
    found, advice = quality(poses, poses[:0])
    assert found.coverage.sparse_frames.all()
    assert advice == ["Train on frames 0 to 119 (around x=0.0, y=0.0): nothing is known."]
