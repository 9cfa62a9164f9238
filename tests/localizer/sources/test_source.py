"""Landmarks as a pose source: estimates and their errors."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.corridor import write_corridor
from conformodal.features.local import extract_local_features
from conformodal.geometry import Trajectory, pose_targets, sign_reference
from conformodal.io import make_split, read_recording
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.training_data import TrainingData
from conformodal.tracking.depths import SceneDepth, track_depth

pytestmark = pytest.mark.slow  # maps a corridor


def data_of(sequence, split, depth_m=None):
    """What the landmarks see, without a network."""
    truth = sequence.require_truth()
    reference = sign_reference(truth.orientations_quat_wxyz)
    features = np.zeros((len(sequence), 1), dtype=np.float32)
    depth = track_depth(sequence, split.train) if depth_m is None else SceneDepth(depth_m)
    return TrainingData(sequence, split, features, pose_targets(truth, reference), reference, depth=depth)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A slow flight, whose views are close to each other."""
    return read_recording(write_corridor(tmp_path_factory.mktemp("slow"), n_modules=3, n_laps=1, seed=3).parent)


@pytest.fixture(scope="module")
def split(sequence):
    return make_split(sequence.recording, "interleaved")


@pytest.fixture(scope="module")
def source(sequence, split):
    return LandmarkSource.fit(data_of(sequence, split), split.train)


def images(sequence, frames):
    return [extract_local_features(sequence.image(int(i)), sequence.camera) for i in frames]


def test_held_out_errors_match_standard_deviations(sequence, split, source):
    off, sigmas = [], []
    for i, image in zip(split.test.tolist(), images(sequence, split.test), strict=True):
        found = source.localize(image)
        if found:
            nearest = min(found, key=lambda one: np.linalg.norm(one.position_xyz - sequence.truth.positions_xyz[i]))
            off.append(np.linalg.norm(nearest.position_xyz - sequence.truth.positions_xyz[i]))
            sigmas.append(1.538 * nearest.sigma_m)
    assert len(off) > 0.8 * len(split.test)
    assert np.median(off) < 0.1
    # standard deviations are those of the tail where that asks for more than the median
    assert 0.15 < np.median(np.divide(off, sigmas)) < 1.5
    assert np.mean(np.array(off) < 2.7955 / 1.538 * np.array(sigmas)) > 0.8  # of 46, and expected is 0.95


def test_without_depths_or_frames_there_are_no_landmarks(sequence, split):
    assert LandmarkSource.fit(data_of(sequence, split, 3.0), split.train[:5]) is None
    assert LandmarkSource.fit(data_of(sequence, split, float("nan")), split.train) is None


def test_poses_of_something_else_give_wide_estimates(sequence, split):
    """Poses that do not belong to the images: no estimate of another image may be narrow."""
    seen, true, rows = images(sequence, range(60, 90)), sequence.truth, np.arange(len(sequence))
    rows[:60] = np.random.default_rng(0).permutation(60)
    wrong = Trajectory(true.timestamps_s, true.positions_xyz[rows], true.orientations_quat_wxyz[rows])
    sigmas_m = []
    for poses in (true, wrong):
        found = LandmarkSource.fit(data_of(replace(sequence, poses=poses), split, 3.0), np.arange(60))
        sigmas_m.append([one.sigma_m for image in seen for one in found.localize(image)])
    assert np.median(sigmas_m[0]) < 0.05
    assert min(sigmas_m[1], default=np.inf) > 0.1
