"""Calibration on stretches, from training to a saved model."""

import numpy as np
import pytest

from conformodal.conformal import grouped_quantile
from conformodal.odometry import (
    Calibration,
    EvidenceKind,
    ModelConfig,
    OdometryError,
    Scene,
    load_model,
    make_folds,
    prepare_training_data,
    save_model,
    train_model,
)
from conformodal.vision import FeatureCache, TrainingConfig


@pytest.fixture(scope="module")
def trained(small_world, sequence):
    known = load_model(small_world.model)
    config = ModelConfig(
        calibrate_on=Calibration.STRETCHES, alpha=0.2, finders=1, local=False, training=TrainingConfig(epochs=1)
    )
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    folds = make_folds(sequence, data.split, config.calibrate_on)
    # a map that is there already, and no fixes by it: to learn one for every fold takes longer than all else
    scene = Scene(3.0, 0.3, known.landmarks, known.landmarks, [[] for _ in folds.held_out], folds.held_out)
    return train_model(data, config, scene=scene), data, folds


def test_thresholds_are_those_of_stretches(trained):
    model, _, folds = trained
    groups = folds.units[folds.held_out]
    np.testing.assert_array_equal(model.calibration.groups_, groups)
    np.testing.assert_array_equal(model.rules.pooled.groups_, groups)
    rule = model.rules.of[EvidenceKind.UNMATCHED]
    columns = model.rules.pooled.scores_.max(axis=1)
    known = model.rules.known_p > model.rules.level
    parts = [columns[known & (groups == g)] for g in np.unique(groups[known])]
    sizes = [int((groups == g).sum()) for g in np.unique(groups[known])]  # a frame keeps its weight in its stretch
    assert rule.n_units == len(parts) <= len(np.unique(groups))
    np.testing.assert_array_equal(rule.thresholds_, np.full(7, grouped_quantile(parts, 0.2, sizes)))
    assert np.isfinite(rule.thresholds_).all()
    assert model.configuration["calibrate_on"] == "stretches"


def test_sources_of_the_region_are_those_of_the_search(trained):
    model, _, folds = trained
    assert model.region_landmarks is model.landmarks
    assert model.head is model.finders[0]
    np.testing.assert_array_equal(model.known.test.groups, folds.units[folds.region_frames])
    assert len(model.known.test.references) == len(folds.region_frames)


def test_frames_are_as_new_as_their_stretch_is(trained):
    """Each calibration frame has the p-value of its own score among the references, without its stretch."""
    model, _, folds = trained
    of = dict(zip(folds.region_frames.tolist(), model.known.test.left_out_p_values(), strict=True))
    np.testing.assert_array_equal(model.rules.known_p, [of[i] for i in folds.held_out.tolist()])


def test_stretches_are_saved_and_loaded(trained, tmp_path):
    model, data, _ = trained
    save_model(model, tmp_path)
    back = load_model(tmp_path)
    np.testing.assert_array_equal(back.calibration.groups_, model.calibration.groups_)
    kinds = np.array(list(EvidenceKind))
    np.testing.assert_array_equal(back.rules.thresholds(kinds), model.rules.thresholds(kinds))
    assert back.region_landmarks is back.landmarks
    assert back.landmarks is not None
    features = data.features[data.split.test]
    np.testing.assert_array_equal(back.known_p(features), model.known_p(features))
    back.recalibrate(0.5)
    assert (back.rules.thresholds(kinds[:2]) <= model.rules.thresholds(kinds[:2])).all()
    np.testing.assert_array_equal(back.calibration.groups_, model.calibration.groups_)


def test_a_scene_of_other_folds_is_refused(trained):
    model, data, folds = trained
    config = ModelConfig(calibrate_on=Calibration.STRETCHES, training=TrainingConfig(epochs=1))
    other = Scene(3.0, 0.3, model.landmarks, model.landmarks, [[] for _ in folds.held_out], folds.held_out[::-1])
    with pytest.raises(OdometryError, match="other folds"):
        train_model(data, config, scene=other)
