"""Stretches that were cut out by hand are found where they were cut, and elsewhere nothing is reported."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory
from conformodal.quality.advice import advice, verdict
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.view_coverage import ViewScale, pose_coverage

SCALE = ViewScale(depth_m=2.0, fov_rad=1.5)  # sparsely covered from 0.15 rad or 0.3 m on
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
    names = np.flatnonzero(np.isin(poses.timestamps_s, known.timestamps_s))
    sequence = SimpleNamespace(recording=recording[: len(poses)], unit="m")
    found = RecordingQuality(sequence, np.arange(len(poses)), poses, names, SCALE, coverage)
    return found, advice(found)


def test_frames_far_from_known_ones_are_sparsely_covered():
    poses = corridor()
    known = poses[(EVERY < 50) | (EVERY >= 70)]
    found, lines = quality(poses, known)
    # 0.04 m a frame: eight frames or more from 49 and from 70 are more than 0.3 m
    assert np.flatnonzero(found.coverage.sparse_frames).tolist() == [57, 58, 59, 60, 61, 62]
    (one,) = found.coverage.sparse
    assert (one.first, one.last) == (57, 62)
    assert one.distance_m == pytest.approx(0.4, abs=0.02)
    assert one.place_xyz[0] == pytest.approx(59.5 * 0.04, abs=0.03)
    assert found.coverage.fast == []
    assert len(lines) == 1
    assert "frames 57 to 62 (around x=2.4, y=0.0)" in lines[0]
    assert "0.40 m and 0 degrees" in lines[0]
    found.sequence.unit = "units"
    assert "0.40 units and 0 degrees" in advice(found)[0]


def test_a_piece_cut_out_of_a_recording_is_found():
    whole = corridor()
    cut = whole[(EVERY < 50) | (EVERY >= 70)]
    found, lines = quality(cut, cut)
    assert found.coverage.sparse == []
    (one,) = found.coverage.fast
    assert (one.first, one.last) == (49, 50)
    assert one.distance_m == pytest.approx(21 * 0.04)
    assert "frames 49 to 50" in lines[0]
    assert "record more views" in lines[0]


@pytest.mark.parametrize("poses", [corridor(), yaw(EVERY * 0.02), path(np.zeros((N, 3)))], ids=["way", "turn", "still"])
def test_where_nothing_is_missing_nothing_is_reported(poses):
    found, lines = quality(poses, poses)
    assert found.coverage.sparse == []
    assert found.coverage.fast == []
    assert lines == []
    assert verdict(found) == "good enough: yes"


def test_a_recording_too_short_to_train_on_is_not_good_enough():
    few = corridor()[:3]
    found, _ = quality(few, few)
    assert verdict(found) == "good enough: no, 3 frames in 3 pieces: too few for a blocks split into three parts"


def test_turns_that_are_missing_are_found():
    turning = yaw(0.02 * EVERY)
    found, _ = quality(turning, turning[:60])
    (one,) = found.coverage.sparse
    # frame 59 is the last that is known; 0.16 rad are more than 0.15
    assert (one.first, one.last) == (67, 119)
    assert one.angle_deg == pytest.approx(np.degrees(60 * 0.02), rel=0.02)


def test_the_nearest_view_equals_brute_force_search():
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
        np.testing.assert_allclose(
            pose_coverage(asked, np.zeros(300, dtype=np.int64), known, SCALE).change, expected, rtol=0.01
        )
