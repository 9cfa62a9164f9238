"""The paper's system: what it is, what it is not, and that it answers a stream as it answers a sequence."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.conformal import SplitConformal
from conformodal.localization.head_source import HeadSource
from conformodal.localization.targets import pose_targets
from conformodal.model.config import Calibration, Method, ModelConfig
from conformodal.model.errors import OdometryError
from conformodal.model.store import load_model, save_model
from conformodal.motion.frontend import EssentialFrontEnd
from conformodal.poses import MotionStatus, angle_between_quats
from conformodal.running.estimator import VisualOdometry
from conformodal.running.paper_odometry import PaperOdometry, odometry_of
from conformodal.training.training import prepare_training_data, train_model
from conformodal.vision.features import FeatureCache
from conformodal.vision.settings import TrainingConfig


@pytest.fixture(scope="module")
def data(sequence, small_world):
    return prepare_training_data(sequence, ModelConfig.paper(), FeatureCache(small_world.cache))


@pytest.fixture(scope="module")
def model(data):
    return train_model(data, ModelConfig.paper(alpha=0.2, training=TrainingConfig(epochs=20)))


@pytest.mark.parametrize("split", ["given", "blocks"])
def test_its_calibration_frames_are_drawn_from_all_training_recordings(sequence, small_world, split):
    n = len(sequence)
    recording = np.arange(n) * 3 // n
    three = replace(sequence, recording=recording, given_test=recording == 2)
    config = ModelConfig.paper(alpha=0.2, split=split, training=TrainingConfig(epochs=3))
    data = prepare_training_data(three, config, FeatureCache(small_world.cache))
    parts = data.split.train, data.split.calibration
    assert len(parts[1]) == pytest.approx(0.2 * sum(len(part) for part in parts), abs=1)
    if split == "given":
        assert [set(recording[part].tolist()) for part in parts] == [{0, 1}, {0, 1}]
    assert (np.diff(parts[1]) > 1).mean() > 0.5  # single frames, not stretches
    trained = train_model(data, config)
    found = odometry_of(trained).process(three, data.split.test[:20], cache=FeatureCache(small_world.cache))
    assert not found.regions.unbounded.all(axis=1).any()


def head_of(model):
    return model.localizer.find(HeadSource).head


def proba_of(model, features):
    return head_of(model).predict_proba(features)


def test_it_is_what_section_2_and_3_say():
    config = ModelConfig.paper()
    assert (config.n_bins, config.margin, config.sigma_bins) == (50, 0, 0)
    assert (config.score, config.joint, config.alpha) == ("lac", "none", 0.1)
    assert (config.sources, config.training.components) == (("head",), None)
    assert ModelConfig.paper(n_bins=10, seed=3).n_bins == 10


@pytest.mark.parametrize(
    "settings",
    [
        {"margin": 0.02},
        {"sigma_bins": 0.7},
        {"score": "density"},
        {"joint": "max"},
        {"sources": ("head", "neighbours")},
        {"novelty_level": 0.1},
        {"calibrate_on": Calibration.STRETCHES},
    ],
)
def test_what_the_paper_does_not_have_is_refused(settings):
    with pytest.raises(OdometryError, match=f"no settings .*{next(iter(settings))}"):
        ModelConfig.paper(**settings)


def test_features_are_the_whole_networks_averaged_over_the_image(data, model):
    assert data.features.shape == (len(data.sequence), 1280 + 32 * 24)
    assert not head_of(model).projection.components[1280:].any()  # the thumbnail counts nothing
    assert head_of(model).projection.components.ndim == 1  # no projection: standardised features


def test_nothing_else_is_in_the_model(model):
    assert model.method is Method.PAPER
    assert [source.name for source in model.localizer.sources] == ["head"]
    assert model.novelty is model.rules.matched is None
    assert model.rules.overall.bins.sizes == model.bins.sizes


def test_each_dimension_is_calibrated_by_itself_and_cuboids_are_the_product(data, model):
    held_out = data.split.calibration
    own = SplitConformal(model.bins, 0.2).calibrate(proba_of(model, data.features[held_out]), data.targets[held_out])
    np.testing.assert_array_equal(own.thresholds_, model.calibration.thresholds_)
    proba = proba_of(model, data.features[data.split.test])
    for one, other in zip(own.predict(proba).masks, model.calibration.predict(proba).masks, strict=True):
        np.testing.assert_array_equal(one, other)
    for p, q, mask in zip(proba, own.thresholds_, model.calibration.predict(proba).masks, strict=True):
        np.testing.assert_array_equal(mask, 1 - p <= q)


def test_a_stream_has_the_answers_of_a_sequence(model, sequence, small_world):
    frames = np.arange(20, 32)
    run = PaperOdometry(model).process(sequence, frames, cache=FeatureCache(small_world.cache))
    stream = PaperOdometry(model)
    for t, i in enumerate(frames.tolist()):
        found = stream.step(sequence.image(i), sequence.timestamps_s[i])
        if i in model.split.calibration:  # a threshold is one of their scores: rounding decides on the bin
            continue
        np.testing.assert_allclose(found.pose.positions_xyz[0], run.trajectory.positions_xyz[t], atol=1e-4)
        assert angle_between_quats(found.pose.orientations_quat_wxyz, run.trajectory.orientations_quat_wxyz[t]) < 1e-4
        assert found.reliable == run.reliable[t]
    assert run.answer == "greedy"
    assert set(run.trajectories) == {"greedy"}


def test_poses_are_means_of_intervals_of_the_region(model, sequence, small_world):
    run = PaperOdometry(model).process(sequence, np.arange(20, 30), cache=FeatureCache(small_world.cache))
    inside = run.regions.contains(pose_targets(run.trajectory, model.sign_reference))
    assert inside[:, :3].all()


def test_it_is_saved_and_loaded(model, data, tmp_path):
    save_model(model, tmp_path)
    back = load_model(tmp_path)
    assert back.method is Method.PAPER
    assert back.backbone.fingerprint == model.backbone.fingerprint
    proba = proba_of(model, data.features[:5]), proba_of(back, data.features[:5])
    for one, other in zip(*proba, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(back.calibration.thresholds_, model.calibration.thresholds_)


def test_neither_system_runs_the_others_models(model, small_world):
    with pytest.raises(OdometryError, match="PaperOdometry runs it"):
        VisualOdometry(model)
    with pytest.raises(OdometryError, match="VisualOdometry runs it"):
        PaperOdometry(load_model(small_world.model))


def test_an_essential_matrix_turns_as_the_camera_does(sequence):
    front_end, truth = EssentialFrontEnd(sequence.camera), sequence.require_truth()
    off = []
    for i in range(30, 45):
        motion = front_end.measure(sequence.image(i))
        if motion is None:
            continue
        before, here = truth.poses_se3[i - 1], truth.poses_se3[i]
        turned = (before[:3, :3] @ motion.R_prev_next).T @ here[:3, :3]
        off.append(np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1))))
        assert np.linalg.norm(motion.direction_prev) == pytest.approx(1)
    assert len(off) == 14
    assert np.median(off) < 1.0


def test_an_image_without_corners_has_no_motion(sequence):
    front_end = EssentialFrontEnd(sequence.camera)
    black = np.zeros((sequence.camera.height, sequence.camera.width, 3), np.uint8)
    assert front_end.measure(black) is None
    assert front_end.measure(black).status is MotionStatus.TOO_FEW
