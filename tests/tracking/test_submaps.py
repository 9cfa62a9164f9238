from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import PinholeCamera
from conformodal.io import read_recording
from conformodal.io.decoding import grey_image
from conformodal.tracking.relative_pose import solve_poselib
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import CornerTracker, TrackedCorners

CAMERA = PinholeCamera(500, 510, 320, 240, 640, 480)


def world(n_frames=12, n_points=300, seed=0, step=0.06, turn=0.01):
    """Poses of a camera on a curve, and points in front of it."""
    rng = np.random.default_rng(seed)
    t = np.arange(n_frames)
    centres = np.column_stack((step * t, 0.02 * np.sin(t / 2), 0.3 * step * t))
    rotations = Rotation.from_rotvec(np.column_stack((0.3 * turn * t, turn * t, 0 * t)))
    points = rng.uniform([-3, -2, 3], [3, 2, 7], (n_points, 3))
    return centres, rotations, points


def on_plane(centre, rotation, points):
    seen = rotation.inv().apply(points - centre)
    return seen[:, :2] / seen[:, 2:]


def corners_of(centres, rotations, points, noise_px=0.0, seed=0, visible=None):
    rng = np.random.default_rng(seed)
    found = []
    for t, centre in enumerate(centres):
        pixels = on_plane(centre, rotations[t], points) * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
        pixels += rng.normal(size=pixels.shape) * noise_px
        there = np.arange(len(points)) if visible is None else visible(t)
        found.append(TrackedCorners(there.astype(np.int64), pixels[there].astype(np.float32)))
    return found


def misfit(submap, centres, rotations):
    """Root mean square per axis, in the submap's unit, with the best length."""
    anchor = submap.frames[0]
    truth = rotations[anchor].inv().apply(centres[submap.frames] - centres[anchor])
    length = (submap.positions * truth).sum() / (submap.positions**2).sum()
    return np.sqrt(((submap.positions - truth / length) ** 2).mean()), length


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_a_path_is_found_but_for_its_length(noise_px):
    centres, rotations, points = world()
    (submap,) = build_submaps(corners_of(centres, rotations, points, noise_px), CAMERA)
    assert submap.frames[0] == 0
    assert submap.frames[-1] == 11
    assert submap.span == 12
    assert len(submap.frames) == 9
    error, length = misfit(submap, centres, rotations)
    assert error < max(submap.sigma / 3, 1e-3)
    assert length > 0
    relative = rotations[0].inv() * rotations[submap.frames]
    off = (Rotation.from_matrix(submap.R_anchor_frame).inv() * relative).magnitude()
    assert off.max() < submap.rotation_sigma_rad
    depths = rotations[0].inv().apply(points - centres[0])[:, 2]
    assert submap.depth * length == pytest.approx(np.median(depths), rel=0.1)


def test_lost_corners_start_an_overlapping_submap():
    centres, rotations, points = world(30, 900)

    def visible(t):  # every frame loses thirty corners and finds thirty others
        return np.arange(30 * t, 30 * t + 300) % 900

    submaps = build_submaps(corners_of(centres, rotations, points, 0.1, visible=visible), CAMERA)
    assert len(submaps) > 3
    for one, two in pairwise(submaps):
        assert one.span <= 8  # 30 % of 300 corners
        assert one.frames[0] < two.frames[0] < one.frames[-1]
    assert submaps[-1].frames[-1] == 29


def test_degenerate_input_gives_no_submap():
    centres, rotations, points = world()
    still = np.zeros_like(centres)
    assert build_submaps(corners_of(still, rotations, points, 0.1), CAMERA) == []  # turns only
    fixed = Rotation.from_rotvec(np.zeros((12, 3)))
    assert build_submaps(corners_of(still, fixed, points, 0.1), CAMERA) == []  # stands still
    assert build_submaps(corners_of(centres, rotations, points)[:2], CAMERA) == []
    assert build_submaps([], CAMERA) == []
    assert build_submaps(corners_of(centres, rotations, points[:20]), CAMERA) == []
    nothing = [TrackedCorners(np.empty(0, np.int64), np.empty((0, 2), np.float32))] * 12
    assert build_submaps(nothing, CAMERA) == []
    rng = np.random.default_rng(0)
    nonsense = [TrackedCorners(c.ids, rng.permutation(c.pixels)) for c in corners_of(centres, rotations, points)]
    assert build_submaps(nonsense, CAMERA) == []


def test_corners_keep_their_numbers(redkitchen):
    sequence = read_recording(redkitchen)
    tracker = CornerTracker()
    seen = []
    for i in range(100, 106):
        tracker.advance(grey_image(sequence.image(i)))
        tracker.mark()
        seen.append(tracker.corners())
        assert len(np.unique(seen[-1].ids)) == len(seen[-1].ids) == len(seen[-1].pixels)
    _, here, there = np.intersect1d(seen[0].ids, seen[-1].ids, return_indices=True)
    assert len(here) > 100
    # the same corners make one motion
    found = solve_poselib(seen[0].pixels[here].astype(float), seen[-1].pixels[there].astype(float), sequence.camera)
    assert found.inliers.mean() > 0.8
    last = max(seen[-1].ids)
    tracker.reset()
    tracker.advance(grey_image(sequence.image(300)))
    tracker.mark()
    assert min(tracker.corners().ids) > last  # another recording's corners are others
