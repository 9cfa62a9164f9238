"""Calibration on stretches, from training to a saved model."""

import numpy as np
import pytest

from conformodal.conformal import hierarchical_quantile
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.config import Calibration, ModelConfig
from conformodal.pipeline.folds import make_folds
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model


@pytest.fixture(scope="module")
def trained(small_world, sequence):
    config = ModelConfig(
        calibrate_on=Calibration.STRETCHES, alpha=0.2, sources=("head",), training=TrainingConfig(epochs=1)
    )
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    folds = make_folds(sequence, data.split, config.calibrate_on)
    return train_model(data, config), data, folds


def test_thresholds_are_those_of_stretches(trained):
    model, _, folds = trained
    groups = folds.units[folds.held_out]
    np.testing.assert_array_equal(model.calibration.units_, groups)
    assert model.rules.recognised is None
    rule = model.rules.by_type[EvidenceType.GLOBAL]
    columns = model.calibration.scores_.max(axis=1)
    known = model.rules.known_p > model.rules.level
    parts = [columns[known & (groups == g)] for g in np.unique(groups[known])]
    sizes = [int((groups == g).sum()) for g in np.unique(groups[known])]  # a frame keeps its weight in its stretch
    assert rule.n_units == len(parts) <= len(np.unique(groups))
    np.testing.assert_allclose(rule.thresholds_, np.full(7, hierarchical_quantile(parts, 0.2, sizes)), rtol=1e-11)
    assert np.isfinite(rule.thresholds_).all()
    assert model.configuration["calibrate_on"] == "stretches"


def test_region_sources_are_fitted_on_all_used_frames(trained):
    model, data, folds = trained
    for source in model.localizer.sources:
        np.testing.assert_array_equal(source.frames, folds.region_frames)
    both = np.concatenate((data.split.train, data.split.calibration))
    np.testing.assert_array_equal(np.sort(both), folds.region_frames)
    np.testing.assert_array_equal(model.novelty.test.units_, folds.units[folds.region_frames])
    assert len(model.novelty.test.references) == len(folds.region_frames)


def test_frames_are_as_new_as_their_stretch_is(trained):
    """Each calibration frame has the p-value of its own score among the references, without its stretch."""
    model, _, folds = trained
    of = dict(zip(folds.region_frames.tolist(), model.novelty.test.left_out_p_values(), strict=True))
    np.testing.assert_array_equal(model.rules.known_p, [of[i] for i in folds.held_out.tolist()])


def test_stretches_are_saved_and_loaded(trained, tmp_path):
    model, data, _ = trained
    save_model(model, tmp_path)
    back = load_model(tmp_path)
    np.testing.assert_array_equal(back.calibration.units_, model.calibration.units_)
    kinds = np.array(list(EvidenceType))
    np.testing.assert_array_equal(back.rules.thresholds(kinds), model.rules.thresholds(kinds))
    evidence = FrameEvidence(data.features[data.split.test])
    one, other = model.localize(evidence), back.localize(evidence)
    np.testing.assert_array_equal(one.known_p, other.known_p)
    assert back.comparison == model.comparison
    assert 0 < model.comparison.n_frames <= len(data.split.test)
    np.testing.assert_array_equal(one.regions.length, other.regions.length)
    back.recalibrate(0.5)
    assert (back.rules.thresholds(kinds[:2]) <= model.rules.thresholds(kinds[:2])).all()
    np.testing.assert_array_equal(back.calibration.units_, model.calibration.units_)
