"""Landmarks as a pose source: estimates, their errors, and what they add to a region."""

import numpy as np
import pytest

from conformodal.features.extract import FeatureCache
from conformodal.features.local import extract_local_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, sign_reference
from conformodal.io import make_split
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.sources.registry import SourceData
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.calibrate import score_beliefs
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.evaluate import RegionStatistics, coverage_table
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model

pytestmark = pytest.mark.slow  # maps a corridor


def data_of(sequence, split, depth_m=None):
    """What the landmarks see, without a network."""
    truth = sequence.require_truth()
    reference = sign_reference(truth.orientations_quat_wxyz)
    features = np.zeros((len(sequence), 1), dtype=np.float32)
    depth = measure_depths(sequence, split.train)[0] if depth_m is None else depth_m
    return SourceData(sequence, features, pose_targets(truth, reference), reference, split.kind, depth)


@pytest.fixture(scope="module")
def split(sequence):
    return make_split(sequence.recording, "interleaved")


@pytest.fixture(scope="module")
def source(sequence, split):
    return LandmarkSource.fit(data_of(sequence, split), split.train)


def trained(sources, small_world, sequence, folder):
    """A model whose network has hardly learnt anything."""
    config = ModelConfig(sources=sources, training=TrainingConfig(epochs=2))
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    save_model(train_model(data, config), folder)
    return load_model(folder)


@pytest.fixture(scope="module")
def model(small_world, sequence, tmp_path_factory):
    return trained(("head", "landmarks"), small_world, sequence, tmp_path_factory.mktemp("landmarks") / "model")


@pytest.fixture(scope="module")
def blind(small_world, sequence, tmp_path_factory):
    return trained(("head",), small_world, sequence, tmp_path_factory.mktemp("blind") / "model")


def images(sequence, frames):
    return [extract_local_features(sequence.image(int(i)), sequence.camera) for i in frames]


def test_errors_of_held_out_frames_are_about_as_large_as_the_standard_deviations(sequence, split, source):
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
    assert np.mean(np.array(off) < 2.7955 / 1.538 * np.array(sigmas)) > 0.85


def test_landmarks_find_the_way_where_a_network_hardly_learnt(model, blind, sequence, small_world):
    test = model.split.test
    truth = sequence.truth[test].positions_xyz

    def median_error(which):
        found = VisualOdometry(which).process(sequence, test).trajectory
        return np.median(np.linalg.norm(found.positions_xyz - truth, axis=1))

    assert median_error(model) < 0.5 * median_error(blind)


def test_without_depths_or_frames_there_are_no_landmarks(sequence, split):
    assert LandmarkSource.fit(data_of(sequence, split, 3.0), split.train[:5]) is None
    assert LandmarkSource.fit(data_of(sequence, split, float("nan")), split.train) is None
    truth, camera = sequence.truth[:30], sequence.camera
    blank = [f._replace(pixels=f.pixels[:0], descriptors=f.descriptors[:0]) for f in images(sequence, range(30))]
    assert LandmarkSource.of(blank, truth, [np.arange(30)], camera, 3.0, np.arange(30)) is None


def test_poses_of_something_else_give_wide_estimates(sequence):
    """Poses that do not belong to the images: no estimate of another image may be narrow."""
    seen, true = images(sequence, range(90)), sequence.truth[:60]
    shuffled = np.random.default_rng(0).permutation(60)
    wrong = Trajectory(true.timestamps_s, true.positions_xyz[shuffled], true.orientations_quat_wxyz[shuffled])
    sigmas_m = []
    for poses in (true, wrong):
        found = LandmarkSource.of(seen[:60], poses, [np.arange(60)], sequence.camera, 3.0, np.arange(60))
        sigmas_m.append([one.sigma_m for image in seen[60:] for one in found.localize(image)])
    assert np.median(sigmas_m[0]) < 0.05
    assert min(sigmas_m[1], default=np.inf) > 0.1


def test_regions_with_landmarks_are_smaller_and_as_sure(model, blind, sequence, small_world):
    run, plain = (VisualOdometry(w).process(sequence, model.split.test) for w in (model, blind))
    truth = sequence.truth[model.split.test]
    with_landmarks, without = (
        RegionStatistics.of(r.regions, truth, model.sign_reference, r.kinds) for r in (run, plain)
    )
    # a corridor that repeats itself: no single estimate is sure, but the region rests on all of them
    assert np.isin(run.kinds, [EvidenceType.UNMATCHED, EvidenceType.LANDMARKS]).mean() > 0.9
    assert np.isin(plain.kinds, [EvidenceType.GLOBAL, EvidenceType.UNKNOWN]).all()
    sizes = [np.median(its.length[:, :3].sum(axis=1)) for its in (with_landmarks, without)]
    assert sizes[0] < 0.7 * sizes[1]
    for statistics, which in ((with_landmarks, model), (without, blind)):
        table = coverage_table(statistics, which, exchangeable=True)
        low, high = table["joint_band_99"]
        assert low <= table["joint_coverage"] <= high
    # the scores say the same as the sets
    targets = pose_targets(truth, model.sign_reference)
    scores = score_beliefs(model.rules.overall, model.localizer, run.localization.beliefs, targets)
    held = (scores <= model.rules.thresholds(run.kinds)).all(axis=1)
    np.testing.assert_array_equal(held, with_landmarks.held)
