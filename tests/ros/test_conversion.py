"""Messages against independent oracles: SciPy's rotations, sampling, and the region's own intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory
from conformodal.localizer.regions import EvidenceType
from conformodal.ros.conversion import Conversion, MessageLimits

pytest.importorskip("rosbags")

SEEDS = range(2)


def matrix_of(message):
    return message.pose.covariance.reshape(6, 6)


def rotation_of(orientation):
    """SciPy takes the real part last, as ROS does."""
    return Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w])


@pytest.mark.parametrize("seed", SEEDS)
def test_orientations_have_the_real_part_last(make_estimate, seed):
    estimate = make_estimate(seed=seed)
    found = Conversion().messages(estimate, 0)
    expected = estimate.pose.pose_se3
    for pose in (found["pose"].pose.pose, found["candidates"].poses[0], found["path"].poses[0].pose):
        np.testing.assert_allclose(rotation_of(pose.orientation).as_matrix(), expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose([pose.position.x, pose.position.y, pose.position.z], expected[:3, 3])


def test_a_forward_camera_has_the_textbook_quaternion():
    """REP 103: optical frame against body frame, x of the world forward and z up."""
    looks = np.column_stack(([0, -1, 0], [0, 0, -1], [1, 0, 0]))  # its right, down and forward, in the world
    quat = Trajectory.from_poses_se3([0.0], [np.block([[looks, np.zeros((3, 1))], [np.eye(4)[3:]]])])
    q = Conversion().poses(quat)[0].orientation
    sign = np.sign(q.w)
    np.testing.assert_allclose(sign * np.array([q.x, q.y, q.z, q.w]), [-0.5, 0.5, -0.5, 0.5], atol=1e-12)


def test_the_covariance_is_that_of_samples_in_the_order_of_ros(some_candidates):
    rng = np.random.default_rng(1)
    one = some_candidates(rng, 3)
    # orientations near each other, as rotation vectors of samples are compared
    tilts = Rotation.from_rotvec(rng.normal(size=(3, 3)) * (0.05, 0.2, 0.4))
    base = Rotation.random(rng=rng)
    quats = (tilts * base).as_quat(scalar_first=True)
    mixture = replace(one, orientations_quat_wxyz=quats)
    place = one.positions_xyz[0]
    n = 400_000
    which = rng.choice(3, n, p=np.exp(one.log_weights))
    positions = mixture.positions_xyz[which] + rng.normal(size=(n, 3)) * mixture.position_spreads[which]
    small = Rotation.from_rotvec(rng.normal(size=(n, 3)) * mixture.orientation_spreads_rad[which, None])
    turned = small * Rotation.from_quat(mixture.orientations_quat_wxyz, scalar_first=True)[which]
    chosen = Rotation.from_quat(quats[0], scalar_first=True)
    off = np.column_stack((positions - place, (turned * chosen.inv()).as_rotvec()))  # x y z, about fixed x y z
    expected = off.T @ off / n
    found = mixture.covariance(place, quats[0])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.02)
    assert np.abs((found / scale)[:3, 3:]).max() > 0.2  # position and rotation go together here


@pytest.mark.parametrize("kind", [None, EvidenceType.UNKNOWN])
def test_lost_frames_say_no_pose(make_estimate, kind):
    conversion = Conversion()
    before = conversion.messages(make_estimate(1.0), 0)
    assert matrix_of(before["pose"]).max() < 100
    found = conversion.messages(make_estimate(2.0, kind), 2_000_000_000)
    np.testing.assert_array_equal(matrix_of(found["pose"]), np.eye(6) * 1e6)
    pose = found["pose"].pose.pose
    assert [pose.position.x, pose.position.y, pose.position.z] == [0, 0, 0]
    assert [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w] == [0, 0, 0, 1]
    assert found["candidates"].poses == []
    assert len(found["candidate_weights"].data) == 0
    assert [marker.action for marker in found["region"].markers] == [3]  # what was drawn before is removed
    assert found["status"].status[0].level == 2
    assert [p.header.stamp.sec for p in conversion.path(3_000_000_000).poses] == [1]
    assert found["pose"].header.stamp.sec == 2


@pytest.mark.parametrize("seed", SEEDS)
def test_boxes_are_the_region(make_estimate, seed):
    estimate = make_estimate(seed=seed)
    expected = sorted(tuple(np.ravel(box[:3])) for box in estimate.region.box_edges(0))
    assert expected
    clear, *markers = Conversion().messages(estimate, 0)["region"].markers
    assert clear.action == 3
    assert [marker.type for marker in markers] == [1] * len(markers)
    assert len({marker.id for marker in markers}) == len(markers) <= 256
    found = []
    for marker in markers:
        middle, size = marker.pose.position, marker.scale
        found.append(
            [end for a, s in zip("xyz", "xyz", strict=True)
             for end in (getattr(middle, a) - getattr(size, s) / 2, getattr(middle, a) + getattr(size, s) / 2)]
        )  # fmt: skip
    np.testing.assert_allclose(sorted(tuple(np.round(box, 9)) for box in found), np.round(expected, 9), atol=1e-9)


def test_boxes_that_are_far_from_the_pose_are_not_drawn(make_estimate, some_candidates):
    estimate = make_estimate(candidates=some_candidates(np.random.default_rng(0), 60))
    all_of_them = Conversion().messages(estimate, 0)["region"].markers[1:]
    near = Conversion(limits=MessageLimits(range_m=1.0)).messages(estimate, 0)["region"].markers[1:]
    assert 0 < len(near) < len(all_of_them)
    assert all(min(m.scale.x, m.scale.y, m.scale.z) > 0 for m in near)


def test_the_most_probable_boxes_are_kept(make_estimate, some_candidates):
    estimate = make_estimate(candidates=some_candidates(np.random.default_rng(0), 60))
    all_of_them = Conversion().messages(estimate, 0)["region"].markers[1:]
    few = Conversion(limits=MessageLimits(max_boxes=3)).messages(estimate, 0)
    assert [m.pose for m in few["region"].markers[1:]] == [m.pose for m in all_of_them[:3]]
    shares = [marker.color.a for marker in all_of_them]
    assert shares == sorted(shares, reverse=True)
    said = {pair.key: pair.value for pair in few["status"].status[0].values}
    assert (said["boxes"], said["boxes_shown"]) == (str(len(all_of_them)), "3")


def test_the_path_is_revised_bounded_and_said_now_and_then(make_estimate):
    conversion = Conversion(limits=MessageLimits(max_path_poses=4, path_every=3))
    quats = np.tile([1.0, 0, 0, 0], (9, 1))
    said = []
    for i in range(7):
        times = np.arange(max(0, i - 1), i + 1, dtype=float)  # the frame before is revised
        places = np.column_stack((times, np.full((len(times), 2), float(i))))
        kind = EvidenceType.UNKNOWN if i == 4 else EvidenceType.GLOBAL
        revised = Trajectory(times, places, quats[: len(times)])
        said.append("path" in conversion.messages(make_estimate(float(i), kind, revised=revised), 0))
    assert said == [True, False, False, True, False, False, True]
    path = conversion.path(6_000_000_000)
    found = [(p.header.stamp.sec, p.pose.position.y) for p in path.poses]
    assert found == [(2, 3), (3, 3), (5, 6), (6, 6)]  # revised when the path was published; 4 was lost
    conversion.reset()
    assert conversion.path(0).poses == []
