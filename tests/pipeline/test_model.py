from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import coverage_band
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.local import extract_local_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import pose_targets
from conformodal.io import Disturbance, read_recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import start
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.config import ModelConfig, OdometryError
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.evaluate import RegionStatistics, coverage_table
from conformodal.pipeline.model import Localization
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from tests.small_model import small_model


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


def test_a_saved_model_gives_the_same_answers(model, sequence, small_world, tmp_path):
    save_model(model, tmp_path / "copy")
    back = load_model(tmp_path / "copy")
    frames = model.split.test[:4]
    features = extract_features(
        [sequence.image_paths[i] for i in frames], model.backbone, FeatureCache(small_world.cache)
    )
    images = [sequence.image(i) // np.uint8(10 if i == frames[0] else 1) for i in frames]
    local = [extract_local_features(image, model.camera, model.detector) for image in images]
    here, there = (which.localize(FrameEvidence(features, local)) for which in (model, back))
    for a, b in zip(here.beliefs.proba, there.beliefs.proba, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(here.candidates, there.candidates, strict=True):
        np.testing.assert_array_equal(a.positions_xyz, b.positions_xyz)
        np.testing.assert_array_equal(a.log_weights, b.log_weights)
    np.testing.assert_array_equal(here.regions.length, there.regions.length)
    np.testing.assert_array_equal(here.known_p, there.known_p)
    np.testing.assert_array_equal(here.kinds, there.kinds)
    for one, other in zip(model.localizer.sources, back.localizer.sources, strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.frames, other.frames)
    np.testing.assert_array_equal(model.calibration.thresholds_, back.calibration.thresholds_)
    for part in ("train", "calibration", "test"):
        np.testing.assert_array_equal(model.split.part(part), back.split.part(part))
    assert back.prior == model.prior
    assert back.camera == model.camera
    assert back.configuration == {**model.configuration, "sources": list(model.configuration["sources"])}


@pytest.mark.slow
@pytest.mark.trained
def test_regions_of_disturbed_images_keep_their_coverage(model, sequence, small_world):
    """Test frames that are disturbed as calibration frames were: exchangeable with them, so coverage has a law."""
    noisy, frames = replace(sequence, noise=Disturbance(seed=5)), model.split.test
    cache = FeatureCache(small_world.cache)
    features = extract_features([sequence.image_paths[i] for i in frames], model.backbone, cache, noise=noisy.noise)
    local = [extract_local_features(noisy.image(i), model.camera, model.detector) for i in frames]
    found = model.localize(FrameEvidence(features, local))
    out = model.quality.is_outside(np.array([its.quality for its in local]))
    assert out.sum() > 10
    assert set(found.kinds[out]) <= {EvidenceType.DISTURBED, EvidenceType.UNKNOWN}
    assert not (found.kinds[~out] == EvidenceType.DISTURBED).any()
    told = found.kinds == EvidenceType.DISTURBED
    assert np.isfinite(found.regions.length[told]).all()
    assert told.sum() > 5
    held = found.regions.contains(pose_targets(sequence.truth[frames], model.sign_reference), joint=True)[told]
    low, _ = coverage_band(model.rules.by_type[EvidenceType.DISTURBED].n_units, int(told.sum()), model.alpha)
    assert low <= held.mean()  # thresholds are no smaller than those of the band


def test_path_regions_are_unbounded_after_a_longer_gap():
    """Longer than any gap of the calibration frames."""
    small = small_model()
    features = np.zeros((3, small.backbone.n_features), np.float32)
    beliefs, limit = small.localizer.beliefs(FrameEvidence(features)), small.path_rules["online"].longest_gap_s
    known = start(beliefs.mixtures[0], known=True)
    answers = Localization(beliefs, None, np.ones(3), np.full(3, EvidenceType.LANDMARKS), np.zeros(3, dtype=int))
    posteriors = [replace(known, unseen_s=gap) for gap in (0.0, limit, 1.01 * limit)]
    unbounded = small.path_regions(answers, posteriors, "online").unbounded
    assert unbounded.all(axis=1).tolist() == [False, False, True]
    assert not unbounded[:2].any()


@pytest.mark.parametrize("alpha", [0.3, "0.3", Fraction(3, 10)])
def test_alpha_has_one_form_before_and_after_saving(small_world, tmp_path, alpha):
    model = load_model(small_world.model)
    assert [rule.alpha for rule in model.rules.by_type.values()] == [0.2] * len(model.rules.by_type)
    model.recalibrate(alpha)
    model.set_novelty_level(0.25)
    save_model(model, tmp_path)
    for one in (model, load_model(tmp_path)):
        for held in (one.calibration.alpha, one.alpha, one.settings["alpha"], one.configuration.get("alpha", 0.3)):
            assert held == 0.3
            assert isinstance(held, float)
        assert one.settings["novelty_level"] == one.configuration.get("novelty_level", 0.25) == 0.25


def test_no_source_has_seen_a_frame_that_calibrates_or_tests(model):
    held_out = np.concatenate((model.split.calibration, model.split.test))
    for source in model.localizer.sources:
        assert not np.isin(held_out, source.frames).any()


@pytest.mark.parametrize(("joint", "score"), [("max", "density"), ("none", "lac")])
def test_every_joint_and_score_survives_saving_and_reasoning(sequence, small_world, tmp_path, joint, score):
    data = prepare_training_data(sequence, ModelConfig(split="interleaved"), FeatureCache(small_world.cache))
    quick = TrainingConfig(epochs=2)
    config = ModelConfig(split="interleaved", alpha=0.2, joint=joint, score=score, sources=("head",), training=quick)
    trained = train_model(data, config)
    save_model(trained, tmp_path)
    back = load_model(tmp_path)
    np.testing.assert_array_equal(trained.calibration.thresholds_, back.calibration.thresholds_)
    run = VisualOdometry(back).process(sequence, back.split.test[:15])
    statistics = RegionStatistics.of(run.regions, sequence.require_truth()[back.split.test[:15]], back.sign_reference)
    table = coverage_table(statistics, back, exchangeable=True)
    assert (table["joint_band_99"] is not None) == (joint == "max")
    assert all("band_99" in row for row in table["targets"].values()) == (joint != "max")


def test_recalibration_nests_regions(model, sequence, small_world):
    odometry = VisualOdometry.load(small_world.model)
    frames = model.split.test[:20]
    wide = odometry.process(sequence, frames).regions
    odometry.model.recalibrate(0.6)
    narrow = odometry.process(sequence, frames).regions
    assert (narrow.length <= wide.length).all()
    assert narrow.length.sum() < wide.length.sum()


def test_unreadable_files_are_omitted_and_reported(sequence, small_world, tmp_path):
    import shutil

    shutil.copytree(small_world.folder, tmp_path / "copy")
    copy = read_recording(tmp_path / "copy")
    copy.image_paths[12].write_bytes(b"no image")
    run = VisualOdometry.load(small_world.model).process(copy, np.arange(10, 16))
    assert run.frames.tolist() == [10, 11, 13, 14, 15]
    assert "frame-000012" in run.unreadable[12]
    for i in (20, 21):
        copy.image_paths[i].unlink()
    with pytest.raises(OdometryError, match="none of 2 frames"):
        VisualOdometry.load(small_world.model).process(copy, np.array([20, 21]))
