"""Points from rays, the tracks that adjust a map, and the camera that is fitted to matches."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import PinholeCamera
from conformodal.geometry.map_poses import Matches, choose_tracks, fit_camera, inlier_rays
from conformodal.geometry.poses import rigid_motions
from conformodal.geometry.triangulation import MIN_PARALLAX_RAD, Rays, triangulate

CAMERA = PinholeCamera(500, 500, 320, 240, 640, 480)


def test_tracks_share_no_corners_and_have_several_views():
    points = np.random.default_rng(0).uniform([-2, -2, 3], [2, 2, 6], (50, 3))
    rays = rays_to(points, np.array([[0.0, 0, 0], [0.5, 0, 0], [-0.5, 0.2, 0], [0, 0.5, 0.1]]), off=0.05)
    chosen = choose_tracks([inlier_rays(rays, triangulate(rays, 0.005), 0.005)], 4)
    np.testing.assert_array_equal(chosen.frame.reshape(-1, 3), [[0, 1, 2]] * len(chosen.points))  # the last is off
    twice = rays._replace(number=rays.number % 8)  # corners of 50 points are said to be those of two
    assert len(choose_tracks([inlier_rays(twice, triangulate(rays, 0.005), 0.005)], 4).points) == 2


def test_few_matches_leave_the_camera_as_it_was():
    nothing = Matches(np.empty((0, 2), np.int64), np.empty((0, 2, 2)), np.empty((0, 2, 2)))
    bent = replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0))
    found = fit_camera(nothing, np.empty((0, 4, 4)), bent, 2.0)
    assert found.camera == CAMERA  # corners come without distortion
    np.testing.assert_array_equal(found.T_pose_cam, np.eye(4))


@pytest.mark.parametrize(("turn_deg", "mount_m"), [(9, 0.0), (34, 0.0), (34, 0.03)])
def test_a_mount_is_not_made_of_noise(turn_deg, mount_m):
    """Where the camera hardly turns, images do not determine where it is mounted; a real mount is found."""
    rng, n = np.random.default_rng(2), 40000
    turns = Rotation.from_euler("yxz", rng.uniform(-turn_deg, turn_deg, (60, 3)) / (1, 3, 3), degrees=True)
    centres = np.column_stack((np.linspace(0, 2, 60), rng.normal(0, 0.1, (60, 2))))
    poses = rigid_motions(turns.as_matrix(), centres)
    cameras = poses @ rigid_motions(np.eye(3), np.array([mount_m, 0, 0]))
    frames = rng.integers(0, 60, (n, 2))
    points = rng.uniform([-2, -2, 3], [4, 2, 5], (n, 3))[:, None]
    local = np.einsum("mkba,mkb->mka", cameras[frames, :3, :3], points - cameras[frames, :3, 3])
    pixels = 500 * local[..., :2] / local[..., 2:] + (320, 240)
    seen = (local[..., 2] > 0.5).all(axis=1) & ((pixels > 0) & (pixels < (640, 480))).all(axis=(1, 2))
    pixels = (pixels + rng.normal(0, 0.3, pixels.shape))[seen & (frames[:, 0] != frames[:, 1])]
    matches = Matches(frames[seen & (frames[:, 0] != frames[:, 1])], pixels, np.zeros_like(pixels))
    found = fit_camera(matches, poses, CAMERA, 4.0)
    np.testing.assert_allclose(found.T_pose_cam[:3, 3], [mount_m, 0, 0], atol=0.003 if mount_m else 0)


def rays_to(points, centres, off=0.0):
    """Rays of all cameras to each point; the last camera's are off."""
    n, k = len(points), len(centres)
    apart = points[:, None] - centres
    plane = apart[..., :2] / apart[..., 2:]
    plane[:, -1] += off
    corner, camera = np.repeat(np.arange(n), k), np.tile(np.arange(k), n)
    return Rays(corner, np.arange(n * k), camera, plane.reshape(-1, 2), np.tile(np.eye(3), (k, 1, 1)), centres)


def test_points_are_where_their_rays_meet():
    points = np.random.default_rng(0).uniform([-2, -2, 3], [2, 2, 6], (50, 3))
    centres = np.array([[0.0, 0, 0], [0.5, 0, 0], [-0.5, 0.2, 0], [0, 0.5, 0.1]])
    found, sound = triangulate(rays_to(points, centres), 0.005)
    assert sound.all()
    np.testing.assert_allclose(found, points, atol=1e-6)
    found, sound = triangulate(rays_to(points, centres, off=0.05), 0.005)  # a match that is wrong in every point
    np.testing.assert_allclose(found[sound], points[sound], atol=0.02)
    assert sound.mean() > 0.9


def test_a_corner_that_no_other_camera_sees_is_no_point():
    points = np.array([[0.1, 0, 4.0], [0.2, 0.1, 5], [0, 0.3, 4]])
    rays = rays_to(points, np.array([[0.0, 0, 0], [0.5, 0, 0]]))
    seen = np.array([True, True, True, False, True, True])
    found, sound = triangulate(
        rays._replace(**{name: getattr(rays, name)[seen] for name in ("corner", "number", "camera", "plane")}), 0.005
    )
    assert sound.tolist() == [True, False, True]
    np.testing.assert_allclose(found[[0, 2]], points[[0, 2]], atol=1e-6)


def test_points_without_parallax_or_behind_are_not_sound():
    centres = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    near = 0.1 / np.tan(1.5 * MIN_PARALLAX_RAD)
    far = 0.1 / np.tan(0.5 * MIN_PARALLAX_RAD)
    _, sound = triangulate(rays_to(np.array([[0.0, 0, near], [0, 0, far]]), centres), 0.005)
    assert sound.tolist() == [True, False]
    behind = rays_to(np.array([[0.3, 0.1, -2.0]]), centres)  # a ray has no sign on the plane: it meets behind
    assert not triangulate(behind, 0.005)[1].any()
