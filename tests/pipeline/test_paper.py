"""The paper's system: what it is, what it is not, and that it answers a stream as it answers a sequence."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.conformal import SplitConformal
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import MotionStatus, RelativeMotion, concatenate
from conformodal.localizer.modes import BinRuns
from conformodal.pipeline.config import Calibration, ModelConfig, OdometryError
from conformodal.pipeline.estimator import VisualOdometry, odometry_of
from conformodal.pipeline.paper import Greedy, PaperOdometry
from conformodal.pipeline.store import load_model
from conformodal.pipeline.train import prepare_training_data, train_model


@pytest.fixture(scope="module")
def data(sequence, small_world):
    return prepare_training_data(sequence, ModelConfig.paper(), FeatureCache(small_world.cache))


@pytest.fixture(scope="module")
def model(data):
    return train_model(data, ModelConfig.paper(alpha=0.2, training=TrainingConfig(epochs=20)))


@pytest.mark.parametrize("split", ["given", "blocks"])
def test_calibration_frames_come_from_all_recordings(sequence, small_world, split):
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
    found = odometry_of(trained).process(three, data.split.test[:20])
    assert not found.regions.unbounded.all(axis=1).any()


def head_of(model):
    return model.localizer.sources[0].head


def proba_of(model, features):
    return head_of(model).predict_proba(features)


@pytest.mark.parametrize(
    "settings",
    [
        {"margin": 0.02},
        {"sigma_bins": 0.7},
        {"score": "density"},
        {"joint": "max"},
        {"sources": ("head", "landmarks")},
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


def test_each_dimension_is_calibrated_separately(data, model):
    held_out = data.split.calibration
    own = SplitConformal(model.bins, 0.2).calibrate(proba_of(model, data.features[held_out]), data.targets[held_out])
    np.testing.assert_array_equal(own.thresholds_, model.calibration.thresholds_)
    proba = proba_of(model, data.features[data.split.test])
    for one, other in zip(own.predict(proba).masks, model.calibration.predict(proba).masks, strict=True):
        np.testing.assert_array_equal(one, other)
    for p, q, mask in zip(proba, own.thresholds_, model.calibration.predict(proba).masks, strict=True):
        np.testing.assert_array_equal(mask, 1 - p <= q)


def test_neither_system_runs_the_others_models(model, small_world):
    with pytest.raises(OdometryError, match="PaperOdometry runs it"):
        VisualOdometry(model)
    with pytest.raises(OdometryError, match="VisualOdometry runs it"):
        PaperOdometry(load_model(small_world.model))


def some_intervals(rng, counts):
    """Intervals in no order, with probabilities in another."""
    return [BinRuns(rng.normal(size=m), rng.uniform(0.1, 0.2, m), np.log(rng.dirichlet(np.ones(m)))) for m in counts]


def greedy(intervals, motions):
    path = Greedy()
    frames = enumerate(zip(intervals, motions, strict=True))
    return concatenate([path.push(*frame).at(float(t)) for t, frame in frames])


def means(runs):
    return [of.mean for of in runs]


def masses(runs):
    return [of.log_mass for of in runs]


def some_motions(rng, n):
    turns = Rotation.random(n, rng=rng).as_matrix()
    headings = rng.normal(size=(n, 3))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    return [None, *(RelativeMotion(MotionStatus.OK, turns[t], headings[t]) for t in range(1, n))]


def brute_force(intervals, motions):
    """Section 3 of the paper, word by word: all combinations, one by one."""
    path = []
    for t, here in enumerate(intervals):
        places = np.array(list(product(*means(here)[:3])))
        quats = np.array(list(product(*means(here)[3:])))
        if t == 0:
            mass = [sum(c) for c in product(*masses(here)[:3])], [sum(c) for c in product(*masses(here)[3:])]
            p, q = places[np.argmax(mass[0])], quats[np.argmax(mass[1])]
        else:
            p_prev, q_prev = path[-1]
            R_prev = Rotation.from_quat(q_prev, scalar_first=True).as_matrix()
            q_next = Rotation.from_matrix(R_prev @ motions[t].R_prev_next).as_quat(scalar_first=True)
            off = [min(np.linalg.norm(q - q_next), np.linalg.norm(q + q_next)) for q in quats]
            t_rel = R_prev @ motions[t].direction_prev
            miss = [np.linalg.norm(t_rel - (p - p_prev) / np.linalg.norm(p - p_prev)) for p in places]
            p, q = places[np.argmin(miss)], quats[np.argmin(off)]
        path.append((p, q / np.linalg.norm(q)))
    return np.array([p for p, _ in path]), np.array([q for _, q in path])


@pytest.mark.parametrize("seed", range(12))
def test_all_combinations_are_tried(seed):
    rng = np.random.default_rng(seed)
    intervals = [some_intervals(rng, rng.integers(1, 6, 7)) for _ in range(8)]
    motions = some_motions(rng, 8)
    found = greedy(intervals, motions)
    positions, quats = brute_force(intervals, motions)
    np.testing.assert_array_equal(found.positions_xyz, positions)
    np.testing.assert_allclose(found.orientations_quat_wxyz, quats, atol=1e-15)


@pytest.mark.parametrize("motion", [None, RelativeMotion(MotionStatus.LOST)])
def test_the_most_probable_is_taken_where_motion_is_unknown(motion):
    rng = np.random.default_rng(1)
    intervals = [some_intervals(rng, [3] * 7) for _ in range(4)]
    found = greedy(intervals, [motion] * 4)
    best = np.array([[m[np.argmax(mass)] for m, mass in zip(means(i), masses(i), strict=True)] for i in intervals])
    np.testing.assert_array_equal(found.positions_xyz, best[:, :3])
    expected = best[:, 3:] / np.linalg.norm(best[:, 3:], axis=1, keepdims=True)
    np.testing.assert_allclose(found.orientations_quat_wxyz, expected)
