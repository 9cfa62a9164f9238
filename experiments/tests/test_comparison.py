"""Trajectories that ours is compared with, computed from a run of ours."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import trajectory_errors
from conformodal.io import read_recording
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.store import load_model
from conformodal.pipeline.train import prepare_training_data
from experiments.regressors import train_tuned
from experiments.worker import TrainedMethods, add_trajectories

N_FRAMES = 80
TRAINING = TrainingConfig(epochs=5)


@pytest.fixture(scope="module")
def world(small_world):
    """The small world's model with two regressors, its run over some test frames, their features, and the truth."""
    sequence, model = read_recording(small_world.folder), load_model(small_world.model)
    cache = FeatureCache(small_world.cache)
    run = VisualOdometry(model).process(sequence, model.split.test[:N_FRAMES])
    data = prepare_training_data(sequence, ModelConfig(split="interleaved", training=TRAINING), cache)
    trained = TrainedMethods(model, train_plain(data, TRAINING), train_tuned(data, TRAINING))
    features = extract_features([sequence.image_paths[i] for i in run.frames], model.backbone, cache)
    return trained, run, features, sequence.require_truth()[run.frames]


def compared(world, recording, **changes):
    trained, run, features, _ = world
    run = replace(run, trajectories=dict(run.trajectories), **changes)
    add_trajectories(trained, run, features, recording)
    return run.trajectories


@pytest.fixture(scope="module")
def whole(world):
    return compared(world, np.zeros(len(world[1].frames), dtype=np.int64))


def check_equal(trajectory, expected):
    np.testing.assert_array_equal(trajectory.timestamps_s, expected.timestamps_s)
    np.testing.assert_allclose(trajectory.positions_xyz, expected.positions_xyz, atol=1e-12)
    np.testing.assert_allclose(trajectory.orientations_quat_wxyz, expected.orientations_quat_wxyz, atol=1e-12)


def test_our_answer_errs_less_than_greedy_and_the_softmax_mean(world, whole):
    trained, _, features, truth = world
    errors = {name: trajectory_errors(path, truth)["rmse_m"] for name, path in whole.items()}
    assert np.isfinite(list(errors.values())).all()
    # greedy stays in the regions, which contain the pose nearly always; the mean lies between look-alikes
    assert errors["smoothed"] < min(errors["greedy"], errors["softmax_mean"])
    np.testing.assert_array_equal(whole["tuned"].positions_xyz, trained.tuned.predict(features)[:, :3])
    assert np.abs(whole["tuned_smoothed"].positions_xyz - whole["tuned"].positions_xyz).max() > 0


def test_no_path_goes_on_from_recording_to_recording(world, whole):
    n = len(world[1].frames)
    half = n // 2
    apart = compared(world, np.repeat([0, 1], [half, n - half]))
    check_equal(apart["softmax_mean"], whole["softmax_mean"])
    check_equal(apart["greedy"][:half], whole["greedy"][:half])
    single = compared(world, np.arange(n))
    still = compared(world, np.arange(n), estimates=[replace(one, relative_motion=None) for one in world[1].estimates])
    check_equal(single["greedy"], still["greedy"])  # no motion leads from frame to frame
