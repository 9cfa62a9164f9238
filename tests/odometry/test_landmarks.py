from dataclasses import replace

import numpy as np
import pytest

from conformodal.datasets import make_split
from conformodal.odometry import (
    FixScale,
    ModelConfig,
    OdometryError,
    VisualOdometry,
    fit_landmarks,
    learn_scene,
    load_model,
    measure_motions,
    prepare_training_data,
    save_model,
    train_model,
)
from conformodal.poses import PoseFix, Trajectory
from conformodal.vision import FeatureCache, TrainingConfig


@pytest.fixture(scope="module")
def split(sequence):
    return make_split(sequence.recording, "interleaved")


@pytest.fixture(scope="module")
def scene(sequence, split):
    return learn_scene(sequence, split)


@pytest.fixture(scope="module")
def model(small_world, sequence, scene, tmp_path_factory):
    config = ModelConfig(training=TrainingConfig(epochs=2), finders=1)
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    folder = tmp_path_factory.mktemp("landmarks") / "model"
    save_model(train_model(data, config, scene=scene), folder)
    return load_model(folder)


def test_fixes_of_held_out_frames_are_about_as_far_off_as_they_claim(sequence, split, scene):
    record = measure_motions(sequence, split.test)
    off, claims = [], []
    for i in split.test.tolist():
        fixes = scene.landmarks.fixes(record.described[i])
        if fixes:
            nearest = min(fixes, key=lambda fix: np.linalg.norm(fix.position_xyz - sequence.truth.positions_xyz[i]))
            off.append(np.linalg.norm(nearest.position_xyz - sequence.truth.positions_xyz[i]))
            claims.append(1.538 * nearest.sigma_m)
    assert len(off) > 0.8 * len(split.test)
    assert np.median(off) < 0.1
    assert 0.4 < np.median(np.divide(off, claims)) < 2.5  # a median of twenty or more ratios whose spread is about one


def test_a_saved_model_has_the_same_landmarks(model, scene, sequence, split):
    assert model.landmarks.scale == scene.landmarks.scale
    assert model.landmarks.map.camera == scene.landmarks.map.camera
    image = measure_motions(sequence, split.test[:3]).described[int(split.test[0])]
    for there, here in zip(model.fixes(image), scene.landmarks.fixes(image), strict=True):
        np.testing.assert_array_equal(there.position_xyz, here.position_xyz)
        assert (there.sigma_m, there.sigma_rad, there.trust) == (here.sigma_m, here.sigma_rad, here.trust)


def test_landmarks_find_the_way_where_a_network_hardly_learnt(model, sequence, small_world):
    test = model.split.test
    truth = sequence.truth[test].positions_xyz
    cache = FeatureCache(small_world.cache)

    def median_error(which):
        found = VisualOdometry(which).process(sequence, test, cache=cache).trajectory
        return np.median(np.linalg.norm(found.positions_xyz - truth, axis=1))

    blind = load_model_without_landmarks(model)
    assert median_error(model) < 0.5 * median_error(blind)


def load_model_without_landmarks(model):
    return replace(model, landmarks=None)


def test_a_stream_is_fixed_as_often_as_asked(model, sequence, monkeypatch):
    asked = []
    monkeypatch.setattr(type(model), "fixes", lambda self, image: asked.append(image) or [])
    odometry = VisualOdometry(model, fix_every=3)
    for i in range(7):
        odometry.step(sequence.image(i), sequence.timestamps_s[i])
    assert len(asked) == 3
    odometry.reset()
    odometry.step(sequence.image(0), 0.0)
    assert len(asked) == 4  # the first frame of every recording
    with pytest.raises(OdometryError, match="fix_every"):
        VisualOdometry(model, fix_every=0)


def test_as_many_lists_of_fixes_as_images(model):
    search = model.search(np.zeros((2, len(model.head.offset)), np.float32))
    with pytest.raises(OdometryError, match="2 images"):
        model.candidates(search, [[]])


def test_without_depths_or_frames_there_are_no_landmarks(sequence, split):
    truth = sequence.truth
    assert fit_landmarks([], truth[:0], np.empty(0, np.int64), sequence.camera, 3.0) is None
    record = measure_motions(sequence, np.arange(30))
    described = list(record.described.values())
    assert fit_landmarks(described, truth[:30], np.arange(30), sequence.camera, float("nan")) is None
    blank = [d._replace(pixels=d.pixels[:0], descriptors=d.descriptors[:0]) for d in described]
    assert fit_landmarks(blank, truth[:30], np.arange(30), sequence.camera, 3.0) is None
    assert learn_scene(sequence, split, landmarks=False).landmarks is None


def test_poses_of_something_else_give_no_landmarks_or_wide_ones(sequence):
    """Poses that do not belong to the images: no other image may get a fix that is trusted."""
    record = measure_motions(sequence, np.arange(90))
    described = [record.described[i] for i in range(90)]
    true = sequence.truth[:60]
    shuffled = np.random.default_rng(0).permutation(60)
    wrong = Trajectory(true.timestamps_s, true.positions_xyz[shuffled], true.orientations_quat_wxyz[shuffled])
    found = fit_landmarks(described[:60], wrong, np.arange(60), sequence.camera, 3.0)
    assert found is None or all(
        fix.trust < 0.5 or fix.sigma_m > 0.1 for image in described[60:] for fix in found.fixes(image)
    )


def test_spreads_and_trust_follow_the_claims():
    scale = FixScale(2.0, 0.5, 3.0, 1.0, -3.0, 1.0)
    small, large = (
        scale.apply(PoseFix(np.zeros(3), np.array([1.0, 0, 0, 0]), s, s, n)) for s, n in ((0.01, 400), (0.04, 20))
    )
    assert small.sigma_m == pytest.approx(0.2)
    assert large.sigma_m == pytest.approx(0.4)
    assert (small.sigma_rad, large.sigma_rad) == pytest.approx((0.03, 0.12))
    assert small.trust == pytest.approx(1 / (1 + np.exp(3) / 400))
    assert large.trust == pytest.approx(1 / (1 + np.exp(3) / 20))
