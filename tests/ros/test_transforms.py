"""Transforms and their messages, against SciPy's rotations and sampling."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.ros.conversion import Conversion, RosError
from conformodal.ros.transforms import covariance_at, hint_of, map_from_odom, matrix_of

pytest.importorskip("rosbags")

SEEDS = range(3)


def rigid(at, rotation):
    return np.vstack((np.column_stack((rotation.as_matrix(), at)), [0, 0, 0, 1]))


def random_transform(rng, reach=5.0):
    return rigid(rng.uniform(-reach, reach, 3), Rotation.random(rng=rng))


def on_the_ground(x, y, heading):
    return rigid([x, y, 0], Rotation.from_euler("z", heading))


@pytest.mark.parametrize("seed", SEEDS)
def test_messages_hold_the_transform_that_they_are_read_as(seed):
    T, conversion = random_transform(np.random.default_rng(seed)), Conversion("hall")
    message = conversion.transform(1_500_000_000, "odom", T)
    assert (message.header.frame_id, message.child_frame_id) == ("hall", "odom")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    q, at = message.transform.rotation, message.transform.translation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), T[:3, :3], atol=1e-12)
    np.testing.assert_allclose([at.x, at.y, at.z], T[:3, 3])
    for each in (message.transform, conversion.pose_of(T)):
        np.testing.assert_allclose(matrix_of(each), T, atol=1e-12)
    q.x, q.y, q.z, q.w = (3 * value for value in (q.x, q.y, q.z, q.w))
    np.testing.assert_allclose(matrix_of(message.transform), T, atol=1e-12)


@pytest.mark.parametrize("quat", [(0, 0, 0, 0), (np.nan, 0, 0, 1)])
def test_what_is_not_a_rotation_is_refused(quat):
    rotation = SimpleNamespace(**dict(zip("xyzw", quat, strict=True)))
    with pytest.raises(RosError, match="must be finite and a rotation"):
        matrix_of(SimpleNamespace(translation=SimpleNamespace(x=0, y=0, z=0), rotation=rotation))


@pytest.mark.parametrize("seed", SEEDS)
def test_map_from_odom_places_the_base_in_the_map(seed):
    rng = np.random.default_rng(seed)
    T_map_base, T_odom_base = random_transform(rng), random_transform(rng)
    found = map_from_odom(T_map_base, T_odom_base) @ T_odom_base
    np.testing.assert_allclose(found, T_map_base, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_on_the_ground_odometry_keeps_its_height_and_tilt(seed):
    rng = np.random.default_rng(seed)
    ground, odometry = on_the_ground(*rng.uniform(-3, 3, 3)), on_the_ground(*rng.uniform(-3, 3, 3))
    tilt = rigid([0, 0, 0.4], Rotation.from_euler("yx", [0.05, -0.03]))
    T_map_odom = map_from_odom(ground @ tilt, odometry, planar=True)
    np.testing.assert_allclose(T_map_odom[2], [0, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose((T_map_odom @ odometry)[:2, 3], ground[:2, 3], atol=1e-9)
    x_axis, expected = (T_map_odom @ odometry)[:2, 0], (ground @ tilt)[:2, 0]
    assert x_axis @ expected == pytest.approx(np.linalg.norm(expected))
    whole = map_from_odom(ground @ tilt, odometry)
    assert np.abs((whole @ odometry)[2, 3]) == pytest.approx(0.4)


def test_the_covariance_at_an_offset_matches_samples():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6)) * 0.02
    covariance, offset = factor @ factor.T, np.array([0.4, -1.0, 2.0])
    off = rng.multivariate_normal(np.zeros(6), covariance, 400_000)
    moved = off[:, :3] + Rotation.from_rotvec(off[:, 3:]).apply(offset) - offset
    expected, found = np.cov(np.column_stack((moved, off[:, 3:])).T), covariance_at(covariance, offset)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.03)
    assert np.abs(found - covariance)[:3, :3].max() > covariance[:3, :3].max()


def stated(T, variances):
    return SimpleNamespace(pose=Conversion().pose_of(T), covariance=np.diag(variances).ravel())


@pytest.mark.parametrize("seed", SEEDS)
def test_a_hint_of_the_base_is_one_of_the_camera(seed):
    rng = np.random.default_rng(seed)
    T_map_base, T_base_cam = random_transform(rng), random_transform(rng, 0.3)
    found = hint_of(stated(T_map_base, [0.04, 0.09, 0.01, 1e-12, 1e-12, 1e-12]), T_base_cam)
    expected = T_map_base @ T_base_cam
    np.testing.assert_allclose(found.positions_xyz[0], expected[:3, 3], atol=1e-9)
    turned = Rotation.from_quat(found.orientations_quat_wxyz[0], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turned, expected[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found.position_spreads[0], [0.2, 0.3, 0.1], rtol=1e-6)
    assert found.weights == 1


@pytest.mark.parametrize(
    ("variances", "metres", "radians"),
    [
        ([0.25, 0.25, 0, 0, 0, np.radians(10) ** 2], [0.5, 0.5, 0.5], np.radians(10)),  # a click in RViz
        ([0.01, 0.04, 0, 0, 0, 0], [0.1, 0.2, 0.2], np.radians(15)),
        ([0] * 6, [0.5] * 3, np.radians(15)),
    ],
)
def test_what_a_hint_leaves_open_is_not_taken_as_sure(variances, metres, radians):
    found = hint_of(stated(np.eye(4), variances), np.eye(4))
    np.testing.assert_allclose(found.position_spreads[0], metres)
    np.testing.assert_allclose(found.orientation_spreads_rad, radians)


@pytest.mark.parametrize("variance", [-1.0, np.nan])
def test_a_hint_with_invalid_variances_is_refused(variance):
    with pytest.raises(RosError, match="variances must be finite and at least 0"):
        hint_of(stated(np.eye(4), [1, variance, 1, 1, 1, 1]), np.eye(4))
