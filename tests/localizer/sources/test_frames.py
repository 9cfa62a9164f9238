"""Which frames the landmarks look at: those that they are fitted on, each once, and no other."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory, rigid_motions
from conformodal.io import Recording, Split, SplitKind
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.landmark_settings import LandmarkSettings, PoseSettings
from conformodal.localizer.sources.landmarks import LandmarkSource, _keyframes
from conformodal.localizer.sources.registry import SourceState
from conformodal.localizer.training_data import SourceSettings, TrainingData
from conformodal.tracking.depths import SceneDepth

N = 60
FRAMES = np.flatnonzero(np.arange(N) % 4 != 1)
ANY_SPLIT = Split(SplitKind.INTERLEAVED, 0, FRAMES, np.arange(1, N, 4), np.empty(0, dtype=np.int64))


@pytest.fixture
def world(world_of):
    return world_of(n=N)


@pytest.fixture
def looked_at(world, monkeypatch):
    """Frames whose local features were extracted, in order; a number stands in for an image."""
    asked, features = [], world.local_features()
    monkeypatch.setattr(Recording, "image", lambda self, i: i)
    monkeypatch.setattr(
        "conformodal.localizer.training_data.frame_features",
        lambda sequence, i, detector: asked.append(i) or features[i],
    )
    return asked


def data_of(poses_se3, camera, depth_m):
    quats = Rotation.from_matrix(poses_se3[:, :3, :3]).as_quat(scalar_first=True)
    times, paths = np.arange(N) / 10, tuple(Path(f"{i}.png") for i in range(N))
    truth = Trajectory(times, poses_se3[:, :3, 3], quats)
    sequence = Recording("points", paths, times, np.zeros(N, np.int64), camera, truth)
    nothing = np.zeros((N, 1), np.float32), np.zeros((N, 7))
    # errors learnt from fewer frames: a third of the time
    settings = SourceSettings(landmarks=LandmarkSettings(n_left_out=15))
    return TrainingData(sequence, ANY_SPLIT, *nothing, quats[0], depth=SceneDepth(depth_m), settings=settings)


@pytest.mark.slow
def test_other_frames_and_their_poses_are_ignored(world, looked_at, stated_camera, depth_m):
    source = LandmarkSource.fit(data_of(world.poses_se3, stated_camera, depth_m), FRAMES)
    assert sorted(looked_at) == FRAMES.tolist()
    np.testing.assert_array_equal(source.frames, FRAMES)
    wrong = world.poses_se3.copy()
    others = np.setdiff1d(np.arange(N), FRAMES)
    wrong[others, :3, 3], wrong[others, :3, :3] = 1e9, np.diag([1.0, -1, -1])
    again = LandmarkSource.fit(data_of(wrong, stated_camera, depth_m), FRAMES)
    one, other = source.state(), again.state()
    assert one.settings == other.settings
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name])


def test_a_stored_source_answers_the_same_to_the_last_bit(world, looked_at, stated_camera, depth_m):
    source = LandmarkSource.fit(data_of(world.poses_se3, stated_camera, depth_m), FRAMES)
    state = source.state()
    settings = json.loads(json.dumps(state.settings))
    back = LandmarkSource.from_state(SourceState({k: v.copy() for k, v in state.arrays.items()}, settings))
    images = [world.see(world.poses_se3[i], seed=500 + i) for i in (1, 5, 9)]
    here, there = (
        which.answer(FrameEvidence(np.zeros((3, 1), np.float32), images)).measurements for which in (source, back)
    )
    assert all(here)
    for its, others in zip(here, there, strict=True):
        for one, other in zip(its, others, strict=True):
            np.testing.assert_equal(vars(one), vars(other))
    for settings in (LandmarkSettings(pose=PoseSettings(n_first=1)), LandmarkSettings(same_place_depths=0.1)):
        with pytest.raises(LocalizationError, match="other settings than the defaults cannot be stored"):
            replace(source, map=replace(source.map, settings=settings)).state()


@pytest.mark.parametrize(("step_m", "every"), [(0.001, 26), (0.013, 2), (0.03, 1)])
def test_frames_of_nearly_the_same_view_are_one_keyframe(step_m, every):
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(N)
    np.testing.assert_array_equal(_keyframes(poses, 1.0, LandmarkSettings()), np.arange(0, N, every))


def test_a_frame_that_turns_is_a_keyframe():
    turned = rigid_motions(Rotation.from_euler("z", [[0.0], [0.01], [0.02], [0.03]]).as_matrix(), np.zeros((4, 3)))
    np.testing.assert_array_equal(_keyframes(turned, 1.0, LandmarkSettings()), [0, 3])


def test_of_an_area_at_most_a_thousand_views_are_keyframes():
    poses = np.tile(np.eye(4), (3000, 1, 1))
    poses[:, 0, 3] = 2.0 * (np.arange(3000) % 2) + 100.0 * (np.arange(3000) >= 2900)
    chosen = _keyframes(poses, 1.0, LandmarkSettings())
    assert [(chosen < 2900).sum(), (chosen >= 2900).sum()] == [1000, 100]
