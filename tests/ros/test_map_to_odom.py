"""Odometry's place in the map from estimates made by hand, and a chain of transforms that SciPy multiplies."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.localizer.regions import EvidenceType
from conformodal.ros.conversion import NANOSECONDS, Conversion, RosError
from conformodal.ros.map_to_odom import MapToOdom
from conformodal.ros.parameters import Parameters
from tests.ros.test_transforms import on_the_ground

pytest.importorskip("rosbags")

T_BASE_CAM = np.array([[0, 0, 1, 0.2], [-1, 0, 0, 0.05], [0, -1, 0, 0.8], [0, 0, 0, 1.0]])
TIMES_S = (10.0, 10.5, 11.0, 11.5)


def matrix(transform):
    q, at, T = transform.rotation, transform.translation, np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [at.x, at.y, at.z]
    return T


def ns(time_s):
    return round(time_s * NANOSECONDS)


def stamp_ns(message):
    return message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec


@pytest.fixture
def robot(transforms):
    """A robot that drives while its odometry turns, with a camera; `make` gives what is tested."""
    rng = np.random.default_rng(0)
    odometry = {ns(t): on_the_ground(t, rng.normal(), 0.3 * t) for t in TIMES_S}
    transforms.set("base_link", "camera", T_BASE_CAM)
    for time_ns, T in odometry.items():
        transforms.set("odom", "base_link", T, time_ns)

    def look_up(target, source, time_ns):
        try:
            return transforms.matrix(target, source, time_ns)
        except Exception as exc:
            raise RosError(f"no transform from {source} to {target}") from exc

    return SimpleNamespace(
        odometry=odometry,
        transforms=transforms,
        make=lambda **given: MapToOdom(Conversion(), look_up, Parameters(**given)),
    )


def status_of(keeper, now_s=0.0, elapsed_s=0.0):
    [status] = keeper.status(ns(now_s), ns(elapsed_s)).status
    assert status.name == "conformodal: localization"
    return status.level, status.message


def test_map_odom_base_camera_is_the_pose(robot, make_estimate):
    keeper = robot.make()
    assert keeper.transform() is None
    for seed, time_s in enumerate(TIMES_S):
        estimate = make_estimate(time_s, seed=seed)
        base = keeper.update(estimate, ns(time_s), "camera")
        message = keeper.transform()
        assert (message.header.frame_id, message.child_frame_id) == ("map", "odom")
        assert stamp_ns(message) == ns(time_s + 1.0)  # the tolerance
        expected = estimate.pose.pose_se3
        T_map_base = matrix(message.transform) @ robot.odometry[ns(time_s)]
        np.testing.assert_allclose(T_map_base @ T_BASE_CAM, expected, atol=1e-9)
        at, q = base.pose.pose.position, base.pose.pose.orientation
        found = SimpleNamespace(translation=at, rotation=q)
        np.testing.assert_allclose(matrix(found), T_map_base, atol=1e-9)
        assert stamp_ns(base) == ns(time_s)
        jacobian = np.eye(6)  # of the base's pose by the camera's, which turns about its own centre
        step, arm = 1e-6, T_map_base[:3, 3] - expected[:3, 3]
        jacobian[:3, 3:] = ((Rotation.from_rotvec(step * np.eye(3)).apply(arm) - arm) / step).T
        own = base.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(own, jacobian @ estimate.covariance @ jacobian.T, rtol=1e-4, atol=1e-8)


def test_without_a_reliable_pose_odometry_stays_where_it_is(robot, make_estimate):
    keeper = robot.make(transform_tolerance=0.2)
    keeper.update(make_estimate(TIMES_S[0]), ns(TIMES_S[0]), "camera")
    kept = matrix(keeper.transform().transform)
    for time_s, kind in zip(TIMES_S[1:3], (EvidenceType.UNKNOWN, None), strict=True):
        base = keeper.update(make_estimate(time_s, kind, seed=5), ns(time_s), "camera")
        assert base.pose.covariance[0] == 1e6
        message = keeper.transform()
        np.testing.assert_array_equal(matrix(message.transform), kept)
        assert stamp_ns(message) == ns(time_s + 0.2)  # fresh all the same
        level, text = status_of(keeper)
        assert level == 1
        assert text.startswith(f"standing still since {time_s - TIMES_S[0]:.1f} s: ")
    keeper.miss("no image for 1 s")
    assert status_of(keeper, elapsed_s=2.0) == (1, "standing still since 3.0 s: no image for 1 s")
    keeper.update(make_estimate(TIMES_S[3], seed=6), ns(TIMES_S[3]), "camera")
    assert np.abs(matrix(keeper.transform().transform) - kept).max() > 0.1
    assert status_of(keeper) == (0, "reliable")


def test_a_pose_that_is_not_reliable_does_not_move_odometry(robot, make_estimate):
    from dataclasses import replace

    keeper = robot.make()
    doubtful = replace(make_estimate(TIMES_S[0]), reliable=False, problem="the region names 2 places")
    assert keeper.update(doubtful, ns(TIMES_S[0]), "camera").pose.covariance[0] < 1e6  # the covariance says how far
    assert keeper.transform() is None
    assert status_of(keeper) == (2, "no reliable pose yet: the region names 2 places")


def test_stamps_of_the_transform_never_go_back(robot, make_estimate):
    keeper = robot.make()
    keeper.update(make_estimate(TIMES_S[0]), ns(TIMES_S[0]), "camera")
    stamps = [stamp_ns(keeper.transform(elapsed)) for elapsed in (0, ns(0.9))]  # the next image is 0.5 s later
    assert stamps[1] - stamps[0] == ns(0.9)
    keeper.update(make_estimate(TIMES_S[1]), ns(TIMES_S[1]), "camera")
    assert stamp_ns(keeper.transform()) == stamps[1] + 1


@pytest.mark.parametrize(("frame", "missing"), [("camera", "from base_link to odom"), ("other", "from other to base")])
def test_what_is_missing_on_tf_is_an_error_that_names_it(robot, make_estimate, frame, missing):
    keeper = robot.make()
    early_s = TIMES_S[0] - 5  # before all odometry
    base = keeper.update(make_estimate(early_s), ns(early_s), frame)
    assert (base is None) == (frame == "other")
    assert keeper.transform() is None
    level, text = status_of(keeper)
    assert level == 2
    assert missing in text
    keeper.miss("no image for 1 s")
    assert status_of(keeper) == (2, "no reliable pose yet: no image for 1 s")
    keeper.update(make_estimate(TIMES_S[0]), ns(TIMES_S[0]), "camera")
    assert status_of(keeper) == (0, "reliable")


def test_the_base_pose_is_published_without_tf(robot, make_estimate):
    keeper = robot.make(publish_tf=False)
    early_s = TIMES_S[0] - 5
    assert keeper.update(make_estimate(early_s), ns(early_s), "camera") is not None  # odometry is not asked for
    assert keeper.transform() is None
    assert status_of(keeper) == (0, "reliable")
    keeper.update(make_estimate(TIMES_S[0], None), ns(TIMES_S[0]), "camera")
    assert status_of(keeper) == (1, "no reliable pose since 5.0 s: no image")


def test_a_planar_robot_keeps_its_odometry_on_the_ground(robot, make_estimate):
    keeper, estimate = robot.make(planar=True), make_estimate(TIMES_S[0], seed=1)
    keeper.update(estimate, ns(TIMES_S[0]), "camera")
    T_map_odom = matrix(keeper.transform().transform)
    np.testing.assert_allclose(T_map_odom[2], [0, 0, 1, 0], atol=1e-12)
    base = T_map_odom @ robot.odometry[ns(TIMES_S[0])]
    expected = estimate.pose.pose_se3 @ np.linalg.inv(T_BASE_CAM)
    np.testing.assert_allclose(base[:2, 3], expected[:2, 3], atol=1e-9)


def test_a_time_that_is_set_back_forgets_odometry(robot, make_estimate):
    keeper = robot.make()
    keeper.update(make_estimate(TIMES_S[3]), ns(TIMES_S[3]), "camera")
    keeper.transform()
    keeper.reset()
    assert keeper.transform() is None
    keeper.update(make_estimate(TIMES_S[0]), ns(TIMES_S[0]), "camera")
    assert stamp_ns(keeper.transform()) == ns(TIMES_S[0] + 1.0)
