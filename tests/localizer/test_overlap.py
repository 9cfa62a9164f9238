from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory
from conformodal.localizer.overlap import Overlap, compare_world_frames, measure_overlap

TURN = Rotation.from_rotvec([0, 0, 0.2])
NEAR = Overlap(0.9, 40, 33)


def in_another_frame(truth):
    poses = (TURN * Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    return Trajectory(truth.timestamps_s, TURN.apply(truth.positions_xyz) + np.array([0.5, 0, 0]), poses)


@pytest.mark.parametrize("outliers", [0, 12])
def test_a_rigid_offset_that_most_images_agree_on_is_measured(outliers):
    rng = np.random.default_rng(0)
    motions = np.tile(np.eye(4), (30, 1, 1))
    motions[:, :3, :3] = (TURN * Rotation.from_rotvec(rng.normal(0, 0.01, (30, 3)))).as_matrix()
    motions[:, :3, 3] = np.array([0.5, 0, 0]) + rng.normal(0, 0.01, (30, 3))
    motions[:outliers, :3, 3] += rng.normal(0, 5, (outliers, 3))
    overlap = compare_world_frames(motions, np.zeros(3), 2.0, NEAR)
    assert (overlap.n_agree, overlap.frames_differ) == (30 - outliers, True)
    assert overlap.offset_m == pytest.approx(0.5, abs=0.02)
    assert overlap.offset_deg == pytest.approx(np.degrees(0.2), abs=1)


@pytest.mark.parametrize("depth_m", [0.3, 2.0, 15.0])
@pytest.mark.parametrize(("depths", "scatter", "differs"), [(0.04, 0, False), (0.06, 0.04, True), (0.06, 0.08, False)])
def test_offset_is_relative_to_depth_and_scatter(depth_m, depths, scatter, differs):
    motions = np.tile(np.eye(4), (33, 1, 1))
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    motions[1:, :3, 3] = scatter * np.column_stack((np.cos(angles), np.sin(angles), 0 * angles))
    motions[:, 0, 3] += depths
    motions[:, :3, 3] *= depth_m
    overlap = compare_world_frames(motions, np.zeros(3), depth_m, NEAR)
    assert (overlap.n_agree, overlap.offset_m) == (33, pytest.approx(depths * depth_m))
    assert overlap.frames_differ == differs


@pytest.mark.slow
def test_recordings_in_two_world_frames_are_detected(sequence):
    rows = slice(None, None, 2)  # of rooms that look alike
    images = {name: getattr(sequence, name)[rows] for name in ("image_paths", "timestamps_s", "recording")}
    sequence = replace(sequence, **images, poses=sequence.truth[rows])
    same = measure_overlap(sequence, sequence, depth_m=2.5)
    other = measure_overlap(sequence, replace(sequence, poses=in_another_frame(sequence.truth)), depth_m=2.5)
    assert same.share_near == 1
    assert not same.frames_differ
    assert other.frames_differ
    assert "the world frames are likely" in other.describe("a", "b")
