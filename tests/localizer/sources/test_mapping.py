import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.features.local import LocalFeatures
from conformodal.geometry.camera import NO_FLOW
from conformodal.geometry.triangulation import triangulate
from conformodal.localizer.landmark_settings import LandmarkMapSettings, LandmarkSettings, PoseSettings
from conformodal.localizer.sources import mapping
from conformodal.localizer.sources.landmark_map import MIN_INLIERS, LandmarkMap
from tests.localizer.sources.conftest import CAMERA, DEPTH, make_world, poses_along


@pytest.fixture(scope="module")
def mapped():
    """A world and its map; an image near the middle of the way."""
    world = make_world()
    return (
        world,
        LandmarkMap.build(world.local_features(), world.poses_se3, CAMERA, DEPTH),
        world.see(world.poses_se3[30], seed=3),
    )


def errors(estimate, pose):
    turned = Rotation.from_quat(estimate.orientation_quat_wxyz, scalar_first=True).inv() * Rotation.from_matrix(
        pose[:3, :3]
    )
    return np.linalg.norm(estimate.position_xyz - pose[:3, 3]), turned.magnitude()


@pytest.mark.parametrize("origin", [(0, 0, 0), (744073.3, 2553112.0, 0.2), (4.2e6, 1.7e5, 4.8e6)])  # UTM, ECEF
def test_an_image_between_the_keyframes_is_found(world_of, stated_camera, depth_m, origin):
    world = world_of()
    poses = world.poses_se3.copy()
    poses[:, :3, 3] += origin
    landmarks = LandmarkMap.build(world.local_features()[::2], poses[::2], stated_camera, depth_m)
    off = []
    for i in range(1, len(poses), 2):
        (estimate,) = landmarks.localize(world.see(world.poses_se3[i], seed=500 + i, wrong=0.3))
        off.append(errors(estimate, poses[i]))
        assert estimate.n_inliers > 100
    assert np.median(off, axis=0) == pytest.approx(0, abs=0.004)  # metres and radians
    assert np.max(off, axis=0) == pytest.approx(0, abs=0.02)


def test_rooms_that_look_the_same_are_both_found(mapped):
    """Descriptors are rounded: the nearest may seem to have no distance at all, the other one as far off."""
    world, _, _ = mapped
    poses = np.concatenate((world.poses_se3, world.poses_se3))
    poses[len(world.poses_se3) :, 0, 3] += 20
    landmarks = LandmarkMap.build(world.local_features() * 2, poses, CAMERA, DEPTH)
    for i in range(5, 55, 5):
        found = landmarks.localize(world.local_features()[i])
        assert sorted(round(one.position_xyz[0] - world.poses_se3[i][0, 3]) for one in found) == [0, 20], i


@pytest.mark.parametrize(
    ("factor", "turn", "place"), [(0.88, (0.01, -0.02, 0.015), (0.03, -0.02, 0.05)), (1.0, (0, 0, 0), (0, 0, 0))]
)
def test_the_camera_is_found_from_the_poses(world_of, stated_camera, depth_m, factor, turn, place):
    world = world_of(factor=factor, turn=turn, place=place)
    landmarks = LandmarkMap.build(world.local_features(wrong=0.2), world.poses_se3, stated_camera, depth_m)
    assert landmarks.camera.fx == pytest.approx(factor * stated_camera.fx, rel=0.01)
    assert Rotation.from_matrix(landmarks.T_pose_cam[:3, :3]).as_rotvec() == pytest.approx(turn, abs=0.003)
    assert landmarks.T_pose_cam[:3, 3] == pytest.approx(place, abs=0.02)
    pose = world.poses_se3[7]
    pose = np.block([[pose[:3, :3], pose[:3, 3:] + 0.05], [np.zeros((1, 3)), 1]])
    (estimate,) = landmarks.localize(world.see(pose, seed=99))
    assert errors(estimate, pose) == pytest.approx((0, 0), abs=0.02)


def test_a_rolling_shutter_is_found_and_compensated(world_of, stated_camera, depth_m):
    world, rng, shutter = world_of(), np.random.default_rng(2), np.array([-0.005, 0.02])

    def rolled(image):
        flow = np.column_stack((rng.normal(0, 0.5, (2, 2)), rng.normal(0, 400, 2)))
        still = image._replace(flow=flow)
        return still._replace(pixels=still.compensate_rolling_shutter(-shutter, stated_camera).pixels)

    landmarks = LandmarkMap.build(
        [rolled(image) for image in world.local_features()], world.poses_se3, stated_camera, depth_m
    )
    assert landmarks.shutter == pytest.approx(shutter, abs=0.001)
    off = {True: [], False: []}
    for i in range(2, 58, 5):
        image = rolled(world.see(world.poses_se3[i], seed=800 + i))
        for known, its in ((True, image), (False, image._replace(flow=NO_FLOW))):
            off[known].append(errors(landmarks.localize(its)[0], world.poses_se3[i]))
    assert (np.median(off[True], axis=0) < 0.5 * np.median(off[False], axis=0)).all()


def test_map_adjustment_corrects_noisy_poses(world_of, stated_camera, depth_m):
    world, rng = world_of(), np.random.default_rng(1)
    given = world.poses_se3.copy()
    given[:, :3, 3] += rng.normal(0, 0.03, (len(given), 3))
    given[:, :3, :3] = given[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.01, (len(given), 3))).as_matrix()
    images, off = world.local_features(), {}
    usual = LandmarkMapSettings().rounds
    for rounds in (0, usual):
        settings = LandmarkSettings(mapping=LandmarkMapSettings(rounds=rounds))
        landmarks = LandmarkMap.build(images, given, stated_camera, depth_m, settings=settings)
        found = [landmarks.localize(world.see(world.poses_se3[i], seed=700 + i))[0] for i in range(2, 58, 5)]
        off[rounds] = [errors(one, world.poses_se3[i]) for one, i in zip(found, range(2, 58, 5), strict=True)]
    assert (np.median(off[usual], axis=0) < (0.8, 0.95) * np.median(off[0], axis=0)).all()
    true = (world.poses_se3 - given)[:, :3, 3]
    assert np.corrcoef(landmarks.corrections[:, :3].ravel(), true.ravel())[0, 1] > 0.6


def test_weak_corners_are_tried_if_landmarks_are_few(world_of, stated_camera, depth_m, monkeypatch):
    world = world_of(n=20)
    images = world.local_features(wrong=0.2)
    images[3] = images[3]._replace(pixels=images[3].pixels[:0], descriptors=images[3].descriptors[:0])
    given, triangulated = {}, {}
    for first in (40, 10_000):
        settings = LandmarkSettings(mapping=LandmarkMapSettings(max_landmarks=30, tried_first=first))
        triangulated[first] = []

        def counted(rays, tolerance, asked=triangulated[first]):
            asked.append(len(rays.first))
            return triangulate(rays, tolerance)

        monkeypatch.setattr(mapping, "triangulate", counted)
        given[first] = LandmarkMap.build(images, world.poses_se3, stated_camera, depth_m, settings=settings)
    np.testing.assert_array_equal(given[40].points_xyz, given[10_000].points_xyz)
    np.testing.assert_array_equal(given[40].starts, given[10_000].starts)
    assert np.diff(given[40].starts)[3] == 0
    assert sum(triangulated[40]) < sum(triangulated[10_000])


def test_hidden_keyframes_do_not_help(mapped):
    _, landmarks, image = mapped
    assert landmarks.localize(image)
    assert landmarks.localize(image, np.ones(60, dtype=bool)) == []
    only = np.ones(60, dtype=bool)
    only[50] = False
    (estimate,) = landmarks.localize(image, only)
    assert estimate.n_inliers < landmarks.localize(image)[0].n_inliers


def test_two_places_that_look_alike_give_two_estimates(world_of, stated_camera, depth_m):
    world = world_of(n=40)
    shift = np.array([100.0, 0, 0])
    far = world.poses_se3.copy()
    far[:, :3, 3] += shift
    images = world.local_features()
    landmarks = LandmarkMap.build([*images, *images], np.concatenate((world.poses_se3, far)), stated_camera, depth_m)
    estimates = landmarks.localize(world.see(world.poses_se3[11], seed=77))
    assert len(estimates) == 2
    near = sorted(estimate.position_xyz[0] for estimate in estimates)
    assert near[1] - near[0] == pytest.approx(100, abs=0.05)


def test_place_in_distant_keyframes_is_solved_once(monkeypatch, world_of, stated_camera, depth_m):
    world = world_of()
    world.poses_se3 = poses_along(60, sideways=6.0)
    settings = LandmarkSettings(pose=PoseSettings(max_distance_ratio=100))
    images, poses = world.local_features()[::4], world.poses_se3[::4]
    landmarks = LandmarkMap.build(images, poses, stated_camera, depth_m, settings=settings)
    image = world.see(world.poses_se3[30], seed=3)
    (once,) = landmarks.localize(image)
    monkeypatch.setattr(LandmarkMap, "_agree", lambda *_: False)
    every = landmarks.localize(image)
    assert len(every) > 1
    assert max(np.linalg.norm(one.position_xyz - once.position_xyz) for one in every) < 0.02


def followed(landmarks, view, pose, rng, wrong=0.0):
    """An image of the landmarks of a view from another pose: some corners are lost, some are followed to elsewhere."""
    local = (landmarks.points_xyz[view.landmarks] - pose[:3, 3]) @ pose[:3, :3]
    pixels = local[:, :2] / local[:, 2:] * landmarks.camera.fx + (CAMERA.cx, CAMERA.cy)
    pixels += rng.normal(0, 0.3, pixels.shape)
    slipped = rng.random(len(pixels)) < wrong
    pixels[slipped] += rng.uniform(20, 60, (int(slipped.sum()), 2))
    nothing = np.empty((0, 0), np.uint8), np.empty(0, np.float32)
    return LocalFeatures(pixels, *nothing), view._replace(corners=np.arange(len(pixels))), slipped


def test_a_pose_is_refined_from_corners_that_were_followed(mapped):
    world, landmarks, image = mapped
    [before] = landmarks.localize(image)
    rng, pose = np.random.default_rng(2), world.poses_se3[30].copy()
    pose[:3, 3] += 0.03, -0.02, 0.01
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0.02, -0.01, 0.01]).as_matrix()
    now, view, slipped = followed(landmarks, before.view, pose @ world.T_pose_cam, rng, wrong=0.2)
    after = landmarks.carry(now, view)
    assert errors(after, pose) == pytest.approx((0, 0), abs=0.005)
    assert not slipped[after.view.corners].any()
    assert after.n_inliers > 0.95 * (~slipped).sum()
    np.testing.assert_array_equal(after.view.landmarks, view.landmarks[after.view.corners])
    assert after.inlier_share == pytest.approx(0.8, abs=0.1)


def test_a_pose_from_too_few_followed_corners_is_none(mapped):
    world, landmarks, image = mapped
    [before] = landmarks.localize(image)
    now, view, _ = followed(landmarks, before.view, world.poses_se3[30] @ world.T_pose_cam, np.random.default_rng(2))
    few = view._replace(corners=view.corners[:10], landmarks=view.landmarks[:10])
    assert landmarks.carry(now, few) is None


def test_a_keyframe_keeps_at_most_300_landmarks(mapped):
    counts = np.diff(mapped[1].starts)
    assert counts.max() == 300
    assert len(mapped[1].points_xyz) == counts.sum()


def test_an_image_of_something_else_gives_no_estimate(mapped):
    other = make_world(seed=9)
    estimates = mapped[1].localize(other.see(other.poses_se3[3]))
    assert all(estimate.n_inliers < 2 * MIN_INLIERS for estimate in estimates)


def test_a_camera_far_from_the_given_one_is_not_believed(world_of, stated_camera, depth_m):
    world = world_of(factor=2.2)
    assert LandmarkMap.build(world.local_features(), world.poses_se3, stated_camera, depth_m).camera == stated_camera


def test_a_map_does_not_depend_on_the_number_of_threads(monkeypatch, world_of, stated_camera, depth_m):
    world, maps = world_of(n=20), []
    for n in (1, 3):
        monkeypatch.setenv("OMP_NUM_THREADS", str(n))
        maps.append(LandmarkMap.build(world.local_features(wrong=0.2), world.poses_se3, stated_camera, depth_m))
    for name in ("points_xyz", "descriptors", "starts", "T_pose_cam"):
        np.testing.assert_array_equal(getattr(maps[0], name), getattr(maps[1], name))


def test_extended_map_keeps_old_and_localizes_new(world_of, stated_camera, depth_m):
    """Half of the frames are mapped, those of one side; the rest join, without images of the first half."""
    world = world_of(n=60, turn=(0.01, -0.02, 0.01), place=(0.02, 0.01, 0))
    features, poses = world.local_features(), world.poses_se3
    first = LandmarkMap.build(features[:40], poses[:40], stated_camera, depth_m)
    grown = first.extended(features[40:], poses[40:], None)
    for name in ("points_xyz", "descriptors", "poses_se3", "corrections", "global_descriptors"):
        before = getattr(first, name)
        np.testing.assert_array_equal(getattr(grown, name)[: len(before)], before)
    assert len(grown.starts) == 61
    assert grown.starts[-1] == len(grown.points_xyz) > len(first.points_xyz)
    new = grown.points_xyz[len(first.points_xyz) :].astype(float)
    off = np.linalg.norm(new[:, None] - world.points[None], axis=2).min(axis=1)
    assert np.median(off) < 0.03
    pose = poses[52].copy()
    pose[:3, 3] += 0.02
    seen = world.see(pose, seed=99)
    errors = [_nearest_error(one.localize(seen), pose) for one in (first, grown)]
    assert errors[1] < 0.01
    assert errors[1] < errors[0]


def test_poses_of_new_frames_are_adjusted_to_the_map(world_of, stated_camera, depth_m):
    world = world_of(n=60)
    features, poses, new = world.local_features(), world.poses_se3, np.arange(60) % 3 == 1
    given = poses.copy()
    given[:, :3, 3] += 0.01 * np.random.default_rng(3).normal(size=(60, 3))
    features = [
        [one for one, joins in zip(features, new, strict=True) if bool(joins) is which] for which in (False, True)
    ]
    first = LandmarkMap.build(features[0], given[~new], stated_camera, depth_m)
    grown = first.extended(features[1], given[new], None)
    adjusted = given[new, :3, 3] + grown.corrections[40:, :3]
    off, before = (np.linalg.norm(each - poses[new, :3, 3], axis=1) for each in (adjusted, given[new, :3, 3]))
    assert np.median(off) < 0.5 * np.median(before)


def _nearest_error(estimates, pose):
    return min((np.linalg.norm(one.position_xyz - pose[:3, 3]) for one in estimates), default=np.inf)
