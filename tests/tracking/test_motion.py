import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.corridor.flight import rotation_world_cam
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.geometry import MotionStatus, PinholeCamera
from conformodal.io.decoding import grey_image
from conformodal.tracking.relative_pose import (
    DIRECTION_FACTOR,
    ROTATION_FACTOR,
    estimate_relative_motion,
    image_cells,
    plane_motions,
    solve_opencv,
    solve_poselib,
)
from conformodal.tracking.tracker import CornerTracker, ImageCorners, MotionFrontEnd, follow_corners

CAMERA = PinholeCamera(500, 510, 320, 240, 640, 480)


def two_views(rotvec, centre, n=200, seed=0, noise_px=0.0, plane=False):
    """Pixels of random points in two cameras; the second has pose (R_prev_next, centre) in the first."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (n, 3))
    if plane:
        points[:, 2] = 6 + 0.3 * points[:, 0]
    R_prev_next = Rotation.from_rotvec(rotvec).as_matrix()

    def project(x):
        return x[:, :2] / x[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)

    after = (points - centre) @ R_prev_next
    noise = rng.normal(size=(2, n, 2)) * noise_px
    return project(points) + noise[0], project(after) + noise[1], R_prev_next


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("plane", [False, True])
def test_no_sign_or_order_error_survives(seed, plane):
    rng = np.random.default_rng(seed)
    rotvec, centre = rng.normal(size=3) * 0.08, rng.normal(size=3) * 0.5
    before, after, R = two_views(rotvec, centre, seed=seed, plane=plane)
    motion = estimate_relative_motion(before, after, CAMERA)
    ways = plane_motions(before, after, CAMERA)
    assert bool(ways) == plane
    truth = centre / np.linalg.norm(centre)
    if plane:  # the truth is among the motions that the plane allows
        assert min(np.abs(R_way - R).max() + np.abs(way - truth).max() for R_way, way in ways) < 1e-4
    if len(ways) == 2:
        assert motion.status is MotionStatus.PLANE
        assert motion.direction_prev is None
        assert Rotation.from_matrix(motion.R_prev_next.T @ R).magnitude() < 2 * motion.rotation_sigma_rad
    else:
        assert motion.status is MotionStatus.OK
        np.testing.assert_allclose(motion.R_prev_next, R, atol=1e-4)
        np.testing.assert_allclose(motion.direction_prev, truth, atol=2e-3)


def test_pure_rotation_gives_no_direction():
    before, after, R = two_views([0.02, 0.1, -0.03], np.zeros(3), noise_px=0.2)
    motion = estimate_relative_motion(before, after, CAMERA)
    assert motion.status is MotionStatus.LOW_PARALLAX
    assert motion.direction_prev is None
    assert np.degrees(Rotation.from_matrix(motion.R_prev_next.T @ R).magnitude()) < 0.1


def test_repeated_frames_lost_corners_and_nonsense_are_named():
    before, after, _ = two_views([0.01, 0, 0], np.array([0.3, 0, 0]))
    repeated = estimate_relative_motion(before, before, CAMERA)
    assert repeated.status is MotionStatus.REPEATED
    np.testing.assert_array_equal(repeated.R_prev_next, np.eye(3))
    assert repeated.direction_prev is None
    assert estimate_relative_motion(before[:5], after[:5], CAMERA, 300).status is MotionStatus.LOST
    assert estimate_relative_motion(before[:5], after[:5], CAMERA, 5).status is MotionStatus.TOO_FEW
    assert estimate_relative_motion(before[:0], after[:0], CAMERA).status is MotionStatus.TOO_FEW
    scrambled = np.random.default_rng(0).permutation(after)
    nonsense = estimate_relative_motion(before, scrambled, CAMERA)
    assert nonsense.status is MotionStatus.INCONSISTENT
    assert not nonsense.reliable


def flight(n=12, step=0.12):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotation_world_cam(np.radians(60 + 2.0 * np.arange(n)))
    poses[:, :3, 3] = np.column_stack((2 + step * np.arange(n), np.full(n, 3.0), np.full(n, 1.3)))
    renderer = Renderer(CorridorWorld(3, seed=0))
    return poses, [renderer.render(p, i) for i, p in enumerate(poses)], renderer.camera


def test_front_end_agrees_with_the_exact_poses_of_the_corridor():
    poses, images, camera = flight()
    front_end = MotionFrontEnd(camera)
    assert front_end.measure(images[0]) is None
    for t in range(1, len(images)):
        motion = front_end.measure(images[t])
        relative = np.linalg.inv(poses[t - 1]) @ poses[t]
        turn = Rotation.from_matrix(motion.R_prev_next.T @ relative[:3, :3]).magnitude()
        assert np.degrees(turn) < 2
        truth = relative[:3, 3] / np.linalg.norm(relative[:3, 3])
        assert motion.direction_prev @ truth > np.cos(np.radians(25))


def test_extra_corners_do_not_affect_the_tracker():
    first, second = (grey_image(image) for image in flight(2)[1])
    others = np.array([[30.5, 40.0], [60.0, 52.25], [-5.0, 3.0]], np.float32)
    alone, both = CornerTracker(), CornerTracker()
    for tracker in (alone, both):
        tracker.advance(first)
        tracker.mark()
    alone.advance(second)
    both.advance(second, ImageCorners(first, others))
    np.testing.assert_array_equal(both.pairs(), alone.pairs())
    for found, expected in zip(both.beside, follow_corners(first, second, others), strict=True):
        np.testing.assert_array_equal(found, expected)
    both.advance(first, ImageCorners(first, others))  # not those of the frame before
    assert both.beside is None


def test_black_blank_and_cut_frames_do_not_break_the_stream():
    _, images, camera = flight()
    black = np.zeros_like(images[0])
    other = Renderer(CorridorWorld(3, seed=9)).render(np.linalg.inv(np.eye(4)) @ flight()[0][0])
    front_end = MotionFrontEnd(camera)
    statuses = [front_end.measure(i) for i in (images[0], images[1], black, black, images[2], images[3], other)]
    assert statuses[1].status in (MotionStatus.OK, MotionStatus.LOW_PARALLAX)
    assert statuses[2].status is MotionStatus.LOST
    assert statuses[3].status is MotionStatus.TOO_FEW
    assert statuses[4].status is MotionStatus.TOO_FEW
    assert statuses[5].reliable
    assert not statuses[6].reliable
    assert statuses[6].n_tracks < statuses[5].n_tracks / 2


@pytest.mark.parametrize("scale", [0.1, 0.4])
def test_motion_sigmas_match_correlated_errors(scale):
    # every cell of the image has one error, which is what the claim assumes; the factors allow for what real data adds
    turns, ways = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        centre = np.array([0.5, 0.1, 0.1])
        before, after, R = two_views([0.01, 0.03, -0.02], centre, n=400, seed=seed)
        after = after + rng.normal(size=(12, 2))[image_cells(before, CAMERA)] * scale
        motion = estimate_relative_motion(before, after, CAMERA)
        error = Rotation.from_matrix(motion.R_prev_next.T @ R).magnitude()
        turns.append(error / 1.538 / motion.rotation_sigma_rad * ROTATION_FACTOR)
        angle = np.arccos(np.clip(motion.direction_prev @ centre / np.linalg.norm(centre), -1, 1))
        ways.append(angle / 1.177 / motion.direction_sigma_rad * DIRECTION_FACTOR)
    assert 1 / 1.6 < np.median(turns) < 1.6
    assert 1 / 1.6 < np.median(ways) < 1.6


LENSES = [(-0.28, 0.07, 2e-4, -1e-4), (0.12, -0.2, 1e-3, 5e-4, 0.05)]


def through_lens(pixels, lens):
    """Radial-tangential distortion written out from its definition (Brown 1966)."""
    k1, k2, p1, p2, k3 = (*lens, 0.0)[:5]
    x, y = ((pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)).T
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.column_stack((bent_x, bent_y)) * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_is_taken_out_of_corners(lens):
    before, after, R = two_views([0.02, -0.08, 0.01], np.array([0.4, 0.1, 0.2]))
    inside = ((before > 0) & (before < (640, 480)) & (after > 0) & (after < (640, 480))).all(axis=1)
    before, after = before[inside], after[inside]
    bent = PinholeCamera(500, 510, 320, 240, 640, 480, lens)
    np.testing.assert_allclose(bent.undistort(through_lens(before, lens)), before, atol=1e-4)
    np.testing.assert_allclose(bent.distort(before), through_lens(before, lens) if lens else before, atol=1e-6)
    motion = estimate_relative_motion(through_lens(before, lens), through_lens(after, lens), bent)
    assert motion.n_inliers == len(before)
    assert Rotation.from_matrix(motion.R_prev_next.T @ R).magnitude() < 1e-4
    ignored = estimate_relative_motion(through_lens(before, lens), through_lens(after, lens), CAMERA)
    assert Rotation.from_matrix(ignored.R_prev_next.T @ R).magnitude() > 5e-4


@pytest.mark.parametrize("solver", [solve_poselib, solve_opencv])
@pytest.mark.parametrize("seed", range(6))
def test_both_solvers_find_the_motion_among_outliers(solver, seed):
    rng = np.random.default_rng(seed)
    rotvec, centre = rng.normal(size=3) * 0.08, rng.normal(size=3) * 0.5
    before, after, R = two_views(rotvec, centre, seed=seed, noise_px=0.1)
    after[:40] = rng.uniform(0, 480, (40, 2))
    motion = solver(before, after, CAMERA)
    assert np.degrees(Rotation.from_matrix(motion.R_prev_next.T @ R).magnitude()) < 0.5
    assert motion.direction_prev @ centre / np.linalg.norm(centre) > np.cos(np.radians(3))
    assert 130 < motion.inliers.sum() < 175
