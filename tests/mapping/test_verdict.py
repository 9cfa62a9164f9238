"""What a map is judged by: each limit that is passed is one reason with a remedy."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.mapping.structure import filter_points
from conformodal.mapping.verdict import MapQuality, judge, mean_error_px
from conformodal.mapping.world import Up, upright

GOOD = MapQuality(
    n_frames=300,
    n_registered=298,
    registered_by_clip={"a.mp4": 0.99, "b.mp4": 1.0},
    n_keyframes=100,
    n_mapped=100,
    n_pieces=1,
    reprojection_px=0.8,
    views_per_point=9.0,
    angle_deg=10.0,
    n_pairs=900,
    agreeing=0.92,
    n_loops=200,
    n_loops_tried=240,
)


def test_a_good_map_has_no_reason_against_it():
    assert judge(GOOD) == []
    assert GOOD.lines()[0] == "registered: 298 of 300 frames (99 %), 100 of 100 keyframes, in 1 piece"


@pytest.mark.parametrize(
    ("changes", "what", "remedy"),
    [
        ({"n_mapped": 3}, "3 keyframes could be joined", "record longer"),
        ({"n_registered": 150}, "50 % of the frames have a place in the map", "record in one go"),
        ({"registered_by_clip": {"a.mp4": 1.0, "b.mp4": 0.1}}, "b.mp4 does not connect", "record it again"),
        ({"agreeing": 0.6}, "60 % of the pairs of keyframes agree", "return to places"),
        ({"reprojection_px": 3.0}, "the reprojection error is 3.0 px", "fixed focus"),
        ({"views_per_point": 2.2}, "points have 2.2 views, from 10.0 degrees", "move the camera sideways"),
        ({"angle_deg": 0.7}, "points have 9.0 views, from 0.7 degrees", "move the camera sideways"),
    ],
)
def test_each_limit_that_is_passed_is_named_with_what_to_record(changes, what, remedy):
    (reason,) = judge(replace(GOOD, **changes))
    assert reason.what.startswith(what)
    assert remedy in reason.remedy


def seen_by(cameras, errors_px):
    """A model in which each camera sees the same points, so many pixels off."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    xyz = np.column_stack((np.random.default_rng(0).uniform(-1, 1, (20, 2)), np.full(20, 4.0)))
    ids = [model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8)) for point in xyz]
    for key, ((width, height, f), off) in enumerate(zip(cameras, errors_px, strict=True), start=1):
        camera = pycolmap.Camera(
            model="PINHOLE", width=width, height=height, params=[f, f, width / 2, height / 2], camera_id=key
        )
        model.add_camera_with_trivial_rig(camera)
        T = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([key - 1.5, 0.0, 0.0]))
        pixels = camera.img_from_cam(xyz + T.translation) + np.array([0.0, off])
        points = [pycolmap.Point2D(pixel) for pixel in pixels]
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{key}", points2D=points, camera_id=key, image_id=key), T
        )
        for k, point in enumerate(ids):
            model.add_observation(point, pycolmap.TrackElement(key, k))
    return model


SMALL, LARGE = (320, 240, 260.0), (3200, 2400, 2600.0)


def test_reprojection_errors_have_the_size_of_their_images():
    model = seen_by([SMALL, LARGE], [3.0, 10.0])
    assert mean_error_px(model) == pytest.approx((3.0 * 640 / 320 + 10.0 * 640 / 3200) / 2)


def test_observations_are_kept_by_the_size_of_their_images():
    for errors, n_kept in (([3.0, 10.0], 20), ([6.0, 10.0], 0), ([3.0, 30.0], 0)):
        model = seen_by([SMALL, LARGE], errors)
        filter_points(model)
        assert model.num_points3D() == n_kept


def cameras(rng, pitch_deg, yaw_spread_deg):
    """Rotations of cameras that are held level, in a world whose z is up; looking down by the pitch."""
    from conformodal.corridor.flight import rotation_world_cam

    yaw = np.radians(yaw_spread_deg) * rng.uniform(-0.5, 0.5, 40)
    return rotation_world_cam(yaw, np.radians(pitch_deg) * np.ones(40), np.radians(rng.normal(0, 1, 40)))


@pytest.mark.parametrize("pitch_deg", [-40, 0, 30])
def test_up_is_found_of_cameras_that_look_up_or_down(pitch_deg):
    rng = np.random.default_rng(0)
    inside = cameras(rng, pitch_deg, 200)
    tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    tilt *= np.sign(np.linalg.det(tilt))
    turn = upright(tilt @ inside)
    assert (turn @ tilt)[2, 2] > np.cos(np.radians(3))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)


def test_up_of_images_that_are_turned_is_what_is_said():
    inside = cameras(np.random.default_rng(1), 0, 200)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x of the turned image is down in the other
    assert (upright(inside @ quarter, Up.LEFT))[2, 2] > 0.99
    assert (upright(inside, Up.BOTTOM))[2, 2] < -0.99
