"""Paths that ours is compared with, worked out from a run of ours."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.datasets import read_sequence
from conformodal.experiments import baseline_training, comparison_paths, train_classical
from conformodal.odometry import ModelConfig, VisualOdometry, load_model, prepare_training_data
from conformodal.poses import trajectory_errors
from conformodal.vision import FeatureCache, TrainingConfig, extract_features

N_FRAMES = 80
TRAINING = TrainingConfig(epochs=5)


@pytest.fixture(scope="module")
def world(small_world):
    """A data set, the small world's model, and its run over some test frames."""
    sequence, model = read_sequence(small_world.folder), load_model(small_world.model)
    run = VisualOdometry(model).process(sequence, model.split.test[:N_FRAMES], cache=FeatureCache(small_world.cache))
    return sequence, model, run


@pytest.fixture(scope="module")
def classical(world, small_world):
    """A regressor, and the features of the run's frames."""
    sequence, model, run = world
    cache = FeatureCache(small_world.cache)
    data = prepare_training_data(sequence, ModelConfig(training=TRAINING), cache)
    paths = [sequence.image_paths[i] for i in run.frames]
    return train_classical(data, baseline_training(TRAINING)), extract_features(paths, model.backbone, cache)


def check_equal(trajectory, expected):
    np.testing.assert_array_equal(trajectory.timestamps_s, expected.timestamps_s)
    np.testing.assert_allclose(trajectory.positions_xyz, expected.positions_xyz, atol=1e-12)
    np.testing.assert_allclose(trajectory.orientations_quat_wxyz, expected.orientations_quat_wxyz, atol=1e-12)


def test_greedy_and_the_softmax_mean_are_worked_out_from_a_run(world):
    sequence, model, run = world
    found = comparison_paths(run, model, sequence.recording[run.frames])
    assert set(found) == {"greedy", "softmax_mean"}
    assert not set(found) & set(run.trajectories)
    truth = sequence.require_truth()[run.frames]
    for path in found.values():
        np.testing.assert_array_equal(path.timestamps_s, run.timestamps_s)
        assert np.isfinite(trajectory_errors(path, truth)["rmse_m"])
    # greedy stays in the regions, which hold the pose nearly always; the mean lies between look-alikes
    ours = trajectory_errors(run.trajectory, truth)["rmse_m"]
    assert ours < min(trajectory_errors(path, truth)["rmse_m"] for path in found.values())


def test_an_answer_is_not_compared_with_itself(world):
    sequence, model, run = world
    found = comparison_paths(replace(run, answer="greedy"), model, sequence.recording[run.frames])
    assert set(found) == {"softmax_mean"}


def test_greedy_does_not_go_on_from_recording_to_recording(world):
    _, model, run = world
    half = len(run.frames) // 2
    apart = comparison_paths(run, model, np.repeat([0, 1], [half, len(run.frames) - half]))
    whole = comparison_paths(run, model, np.zeros(len(run.frames), dtype=np.int64))
    check_equal(apart["softmax_mean"], whole["softmax_mean"])
    check_equal(apart["greedy"][:half], whole["greedy"][:half])
    other = comparison_paths(replace(run, motions=[None] * len(run.frames)), model, np.arange(len(run.frames)))
    single = comparison_paths(run, model, np.arange(len(run.frames)))
    check_equal(single["greedy"], other["greedy"])  # no motion leads from frame to frame


def test_the_regressor_is_answered_recording_by_recording(world, classical):
    _, model, run = world
    regressor, features = classical
    half = len(run.frames) // 2
    parts = np.arange(half), np.arange(half, len(run.frames))
    found = regressor.trajectories(features, run, np.repeat([0, 1], [len(at) for at in parts]), model.prior)
    assert set(found) == {"classical", "classical_smoothed"}
    for at in parts:
        alone = regressor.answers(features[at], run.observations(at), model.prior)
        for name, trajectory in alone.items():
            check_equal(found[name][at], trajectory)
    values = regressor.predict(features)
    np.testing.assert_array_equal(found["classical"].positions_xyz, values[:, :3])
    assert np.abs(found["classical_smoothed"].positions_xyz - values[:, :3]).max() > 0
