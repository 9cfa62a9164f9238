"""What speaks for an estimate: different corners, and experience with frames whose surroundings were hidden."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.localization.landmarks.mapping import build_map, view_overlap
from conformodal.localization.landmarks.source import LandmarkSource
from conformodal.localization.settings import MAPPING
from conformodal.poses import Trajectory


def test_a_corner_counts_once_although_several_keyframes_match_it(world_of, stated_camera, depth_m):
    world = world_of()
    landmarks = build_map(world.local_features(), world.poses_se3, stated_camera, depth_m)
    image = world.see(world.poses_se3[30], seed=3)
    (near,) = landmarks._retrieve(image.global_descriptor, np.ones(60, dtype=bool))
    matches = {}
    landmarks.localize(image, matches=matches)
    assert sorted(matches) == sorted(near)
    corners = np.concatenate([pairs[:, 0] for pairs in matches.values()])
    assert len(corners) > 1.5 * len(np.unique(corners))  # most were matched more than once
    (found,) = landmarks.localize(image)
    assert found.n_inliers <= len(np.unique(corners)) <= len(image.pixels)
    assert 0.9 < found.inlier_share <= 1
    assert 0.5 < found.image_share < 1.5  # points are all over the image
    half = image.pixels[:, 0] < 320
    (found,) = landmarks.localize(image._replace(pixels=image.pixels[half], descriptors=image.descriptors[half]))
    assert found.image_share < 0.7


def test_an_estimate_says_how_far_the_nearest_keyframe_is(world_of, stated_camera, depth_m):
    world = world_of()
    plain = build_map(world.local_features(), world.poses_se3, stated_camera, depth_m)
    landmarks = replace(plain, corrections=np.zeros((60, 6)))
    image = world.see(world.poses_se3[30], seed=3)
    (at,) = landmarks.localize(image)
    (off,) = landmarks.localize(image, np.abs(np.arange(60) - 30) < 8)
    assert at.distance_to_known < 0.02 < off.distance_to_known


def test_a_frame_sees_what_it_sees_and_nothing_behind_it(stated_camera, depth_m):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1, :3, :3] = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()
    poses[2, 0, 3] = 0.5
    poses[3, 0, 3] = 1.5
    shares = view_overlap(poses, 0, stated_camera, depth_m)
    assert shares[0] == 1
    assert shares[1] == 0
    assert 1 > shares[2] > shares[3] > 0


@pytest.mark.slow
def test_estimates_are_sure_where_the_place_is_known_and_another_place_has_none(
    world_of, stated_camera, depth_m, monkeypatch
):
    monkeypatch.setattr(
        "conformodal.localization.landmarks.source.MAPPING", replace(MAPPING, left_out=40)
    )  # of 80: half the time
    world = world_of(n=80)
    times = np.arange(80) / 10
    quats = Rotation.from_matrix(world.poses_se3[:, :3, :3]).as_quat(scalar_first=True)
    truth = Trajectory(times, world.poses_se3[:, :3, 3], quats)
    groups = [np.arange(80), np.arange(80) // 4]
    frames = np.arange(100, 180)
    source = LandmarkSource.of(world.local_features(wrong=0.3), truth, groups, stated_camera, depth_m, frames)
    np.testing.assert_array_equal(source.frames, frames)
    shown = [
        one for i in range(5, 75, 7) for one in source.localize(world.see(world.poses_se3[i], seed=900 + i, wrong=0.3))
    ]
    assert len(shown) == 10
    assert min(one.inlier_probability for one in shown) > 0.5
    other = world_of(n=80, seed=9)  # a place that is not in the map
    assert [one for i in range(5, 75, 7) for one in source.localize(other.see(other.poses_se3[i], seed=900 + i))] == []
