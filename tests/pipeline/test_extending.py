"""Recordings that are added to a trained model."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.settings import TrainingConfig
from conformodal.io import read_recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.region_rules import part_of
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.extending import _split, _warn_of_copies, extend_model
from conformodal.pipeline.model import PATHS
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.tracking.flow import frame_features
from tests.helpers import fly, refusal

ALPHA = 0.2
NEAR_M = 0.2


def part(sequence, rows):
    return replace(
        sequence,
        image_paths=sequence.image_paths[rows],
        timestamps_s=sequence.timestamps_s[rows],
        recording=sequence.recording[rows],
        truth=sequence.truth[rows],
    )


@pytest.fixture(scope="module")
def by_frames(small_world, sequence, tmp_path_factory):
    """The small world's model, which has landmarks, and another flight."""
    folder = fly(tmp_path_factory.mktemp("other") / "seq-01", 100, slice(70), 1000)
    return load_model(small_world.model), sequence, read_recording(folder.parent)


@pytest.fixture(scope="module")
def by_stretches(small_world, sequence):
    """A model of the first half of a flight, and the second half."""
    half = len(sequence) // 2
    first, second = part(sequence, slice(half)), part(sequence, slice(half, None))
    config = ModelConfig(split="blocks", alpha=ALPHA, sources=("head", "neighbours"), training=TrainingConfig(epochs=1))
    return train_model(prepare_training_data(first, config, FeatureCache(small_world.cache)), config), first, second


@pytest.fixture(scope="module", params=["by_frames", "by_stretches"])
def extended(request, cache):
    model, first, second = request.getfixturevalue(request.param)
    return model, extend_model(model, second, cache, check_world=False), first, second


@pytest.fixture(scope="module")
def cache(small_world):
    return FeatureCache(small_world.cache)


def localized(model, sequence, frames, cache):
    """Distances from the truth, and whether regions contain it."""
    features = extract_features([sequence.image_paths[i] for i in frames], model.backbone, cache)
    local = [frame_features(sequence, i) for i in frames.tolist()]
    found = model.localize(FrameEvidence(features, local))
    best = np.array([its.positions_xyz[0] for its in found.candidates])
    targets = pose_targets(sequence.truth, model.sign_reference)[frames]
    off = np.linalg.norm(best - sequence.truth.positions_xyz[frames], axis=1)
    return off, found.regions.contains(targets, joint=True)


def test_new_places_are_answered_and_earlier_ones_no_worse(extended, cache):
    model, more, first, second = extended
    new = more.split.test[more.split.test >= len(first)] - len(first)
    before, _ = localized(model, second, new, cache)
    after, covered = localized(more, second, new, cache)
    # rooms look alike, so that without landmarks many answers stay in the wrong one
    assert np.mean(after < NEAR_M) > np.mean(before < NEAR_M) - (model.landmarks is None) * 0.05
    assert covered.mean() >= 1 - ALPHA - 0.15  # of few frames
    before, _ = localized(model, first, model.split.test, cache)
    after, covered = localized(more, first, model.split.test, cache)
    assert np.median(after) <= 1.1 * np.median(before) + 1e-3
    assert covered.mean() >= 1 - ALPHA - 0.15


def test_earlier_scores_stay_and_new_units_join_them(extended):
    model, more, first, second = extended
    n = model.n_calibration
    np.testing.assert_array_equal(more.calibration.scores_[:n], model.calibration.scores_)
    assert more.n_calibration > n
    if model.calibration.groups_ is not None:
        old, new = more.calibration.groups_[:n], more.calibration.groups_[n:]
        np.testing.assert_array_equal(old, model.calibration.groups_)
        assert old.max() < new.min()
    assert len(more.known_frames) == len(first) + len(second)
    for name in ("train", "calibration", "test"):
        assert (more.split.part(name)[len(model.split.part(name)) :] >= len(first)).all()
    assert model.path_rules.keys() == more.path_rules.keys() == {*PATHS}
    for path, rule in more.path_rules.items():
        old = model.path_rules[path].scores_
        np.testing.assert_array_equal(rule.scores_[: len(old)], old)
        assert len(rule.scores_) > len(old)
    assert more.rules.level == model.rules.level
    assert more.alpha == model.alpha


def test_an_extended_model_is_stored_and_extended_again(extended, cache, tmp_path):
    _, more, first, second = extended
    save_model(more, tmp_path)
    back = load_model(tmp_path)
    for path, rule in more.path_rules.items():
        np.testing.assert_array_equal(back.path_rules[path].thresholds_, rule.thresholds_)
    one, covered = localized(more, first, more.split.test[:5], cache)
    other, again = localized(back, first, more.split.test[:5], cache)
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(covered, again)
    with pytest.raises(OdometryError, match=r"has the pixels of a frame that the model knows, and so have"):
        extend_model(back, second, cache)


def test_another_camera_is_refused(extended, cache):
    model, _, _, second = extended
    with pytest.raises(OdometryError, match="the model was trained with"):
        extend_model(model, replace(second, camera=replace(second.camera, fx=2 * second.camera.fx)), cache)


def test_another_world_frame_is_refused(by_frames, cache):
    model, _, second = by_frames
    away = replace(
        second, truth=replace(second.truth, positions_xyz=second.truth.positions_xyz + np.array([0, 0.5, 0.5]))
    )
    with pytest.raises(OdometryError, match="world frames are likely"):
        extend_model(model, away, cache)


def test_a_recording_that_was_encoded_again_is_told(by_frames):
    model, first, second = by_frames

    def told(positions_xyz, sequence=first):
        moved = replace(sequence, truth=replace(sequence.truth, positions_xyz=positions_xyz))
        with warnings.catch_warnings(record=True) as came:
            warnings.simplefilter("always")
            _warn_of_copies(model, moved)
        return [str(its.message) for its in came]

    positions, n = first.truth.positions_xyz, len(first)
    rounded = positions.round(4)  # as a file has them
    rounded[: n // 20] += 1  # some frames are new
    assert told(rounded) == [
        f"{first.name}: {n - n // 20} of {n} frames have poses of frames that the model knows: is it a copy, encoded "
        "again? Coverage is guaranteed with new recordings only"
    ]
    assert told(positions + np.array([0.01, 0, 0])) == []
    assert told(np.repeat(positions[:5], n, axis=0)[:n]) == []  # a camera that stands still
    assert told(second.truth.positions_xyz, second) == []


def test_the_command_refuses_the_recording_that_it_knows(small_world, tmp_path):
    found = refusal("extend", small_world.model, small_world.folder, "--out", tmp_path / "more", "--no-check-world")
    assert "has the pixels of a frame that the model knows, and so have" in found
    assert not (tmp_path / "more" / "model.json").exists()


def test_one_recording_joins_whole_recordings(by_stretches, cache):
    model, _, second = by_stretches
    whole = replace(model, configuration=model.configuration | {"whole_recordings": True, "split": "recordings"})
    more = extend_model(whole, second, cache, check_world=False)
    n = model.n_calibration
    assert len(np.unique(more.calibration.groups_[n:])) == 1
    assert more.n_calibration == n + len(second)
    assert np.isfinite(more.calibration.scores_).any()
    # one recording is too few for a threshold of its own, so its largest score counts
    own = more.calibration.scores_[n:].max(axis=1)
    assert (more.calibration.thresholds_ >= own[np.isfinite(own)].max()).all()


def test_each_addition_is_covered_by_itself(extended):
    model, more, _, _ = extended
    rule, n = more.calibration, model.n_calibration
    np.testing.assert_array_equal(rule.batches_, np.arange(len(rule.scores_)) >= n)
    alone = part_of(rule, rule.batches_ == 1)
    assert (rule.thresholds_ >= alone.thresholds_).all()
    assert (rule.at(ALPHA / 2).thresholds_ >= rule.thresholds_).all()


def test_earlier_disturbed_images_keep_calibrating(by_frames, cache):
    model, _, second = by_frames
    more = extend_model(model, second, cache, check_world=False)
    n = len(model.rules.disturbed.scores_)
    assert len(more.rules.disturbed.scores_) > n > 0
    np.testing.assert_array_equal(more.rules.disturbed.scores_[:n], model.rules.disturbed.scores_)
    assert len(more.novelty.disturbed.scores_) == len(more.rules.disturbed.scores_)
    assert (more.quality.low <= model.quality.low).all()


def test_frames_that_lists_name_for_testing_stay_out(sequence):
    named = np.arange(len(sequence)) % 4 == 0
    listed = replace(sequence, given_test=named)
    config = ModelConfig(split="given")
    split = _split(listed, config, 5, frames_calibrate=False)
    np.testing.assert_array_equal(split.test, np.flatnonzero(named))
    assert not named[split.train].any()


@pytest.mark.parametrize("split", ["recordings", "given"])
def test_added_frames_calibrate_where_frames_do(sequence, split):
    found = _split(sequence, ModelConfig(split=split), 5, frames_calibrate=True)
    assert min(map(len, (found.train, found.calibration, found.test))) > 0
