from dataclasses import replace

import numpy as np
import pytest

from conformodal.datasets import make_split
from conformodal.experiments import coverage_table
from conformodal.localization import PoseMeasurement, extract_local_features, pose_targets
from conformodal.odometry import (
    EvidenceKind,
    Fixes,
    FixScale,
    ModelConfig,
    OdometryError,
    RegionStatistics,
    VisualOdometry,
    fit_landmarks,
    learn_scene,
    load_model,
    measure_motions,
    prepare_training_data,
    save_model,
    train_model,
)
from conformodal.poses import Trajectory
from conformodal.vision import FeatureCache, TrainingConfig, extract_features


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
    # spreads are those of the tail where that asks for more than the median
    assert 0.15 < np.median(np.divide(off, claims)) < 1.5
    assert np.mean(np.array(off) < 2.7955 / 1.538 * np.array(claims)) > 0.85


def test_a_saved_model_has_the_same_landmarks(model, scene, sequence, split):
    assert model.landmarks.scale == scene.landmarks.scale
    assert model.landmarks.map.camera == scene.landmarks.map.camera
    image = measure_motions(sequence, split.test[:3]).described[int(split.test[0])]
    there = model.fixes(image)
    here = scene.landmarks.fixes(image), scene.region_landmarks.fixes(image)
    assert here[0] or here[1]
    for a, b in zip(there.search + there.region, here[0] + here[1], strict=True):
        np.testing.assert_array_equal(a.position_xyz, b.position_xyz)
        assert (a.sigma_m, a.sigma_rad, a.trust) == (b.sigma_m, b.sigma_rad, b.trust)


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
    return replace(model, landmarks=None, region_landmarks=None, rules=replace(model.rules, pooled=None))


def test_a_stream_is_fixed_as_often_as_asked(model, sequence, monkeypatch):
    asked = []
    monkeypatch.setattr(type(model), "fixes", lambda self, image: asked.append(image) or Fixes())
    odometry = VisualOdometry(model, match_every=3)
    for i in range(7):
        odometry.step(sequence.image(i), sequence.timestamps_s[i])
    assert len(asked) == 3
    odometry.reset()
    odometry.step(sequence.image(0), 0.0)
    assert len(asked) == 4  # the first frame of every recording
    with pytest.raises(OdometryError, match="match_every"):
        VisualOdometry(model, match_every=0)


def test_as_many_lists_of_fixes_as_images(model):
    search = model.search(np.zeros((2, len(model.head.offset)), np.float32))
    with pytest.raises(OdometryError, match="2 images"):
        model.candidates(search, [Fixes()])
    with pytest.raises(OdometryError, match="2 images"):
        model.regions(model.proba(np.zeros((2, len(model.head.offset)), np.float32)), [Fixes()])


def test_without_depths_or_frames_there_are_no_landmarks(sequence, split):
    truth = sequence.truth
    assert fit_landmarks([], truth[:0], [np.empty(0, np.int64)], sequence.camera, 3.0) is None
    record = measure_motions(sequence, np.arange(30))
    described = list(record.described.values())
    assert fit_landmarks(described, truth[:30], [np.arange(30)], sequence.camera, float("nan")) is None
    blank = [d._replace(pixels=d.pixels[:0], descriptors=d.descriptors[:0]) for d in described]
    assert fit_landmarks(blank, truth[:30], [np.arange(30)], sequence.camera, 3.0) is None
    assert learn_scene(sequence, split, landmarks=False).landmarks is None


def test_poses_of_something_else_give_no_landmarks_or_wide_ones(sequence):
    """Poses that do not belong to the images: no other image may get a fix that is trusted."""
    record = measure_motions(sequence, np.arange(90))
    described = [record.described[i] for i in range(90)]
    true = sequence.truth[:60]
    shuffled = np.random.default_rng(0).permutation(60)
    wrong = Trajectory(true.timestamps_s, true.positions_xyz[shuffled], true.orientations_quat_wxyz[shuffled])
    found = fit_landmarks(described[:60], wrong, [np.arange(60)], sequence.camera, 3.0)
    assert found is None or all(
        fix.trust < 0.5 or fix.sigma_m > 0.1 for image in described[60:] for fix in found.fixes(image)
    )


def test_spreads_and_trust_follow_the_claims_the_distance_and_the_evidence():
    scale = FixScale(2.0, 0.5, 1.0, 3.0, 1.0, 0.0, -3.0, (1.0, 2.0))

    def scaled(claim, *evidence, apart=0.1):
        fix = PoseMeasurement(np.zeros(3), np.array([1.0, 0, 0, 0]), claim, claim, 50, apart=apart)
        return scale.apply(fix, *evidence)

    small, large, far = scaled(0.01, 400, 0.5), scaled(0.04, 20, 0.1), scaled(0.01, 400, 0.5, apart=0.4)
    assert (small.sigma_m, large.sigma_m, far.sigma_m) == pytest.approx((0.02, 0.04, 0.08))
    assert (small.sigma_rad, large.sigma_rad, far.sigma_rad) == pytest.approx((0.03, 0.12, 0.03))
    assert small.trust == far.trust == pytest.approx(1 / (1 + np.exp(3) / (400 * 0.5**2)))
    assert large.trust == pytest.approx(1 / (1 + np.exp(3) / (20 * 0.1**2)))
    near = scaled(0.01, 400, 0.5, apart=0.0)  # nothing is nearer than the least
    assert 0 < near.sigma_m == scaled(0.01, 400, 0.5, apart=0.001).sigma_m


def test_fixes_less_sure_than_a_place_is_wide_are_none(scene, sequence, split):
    described = measure_motions(sequence, split.test[:20]).described
    images = [described[i] for i in split.test[:20].tolist()]
    unsure = replace(scene.landmarks, scale=replace(scene.landmarks.scale, position=1e9))
    assert any(scene.landmarks.fixes(image) for image in images)
    assert not any(unsure.fixes(image) for image in images)


def test_regions_know_landmarks_of_the_training_part_alone(sequence, split, scene):
    both = np.sort(np.concatenate((split.train, split.calibration)))
    for known, frames in ((scene.region_landmarks, split.train), (scene.landmarks, both)):
        np.testing.assert_allclose(known.map.poses_se3, sequence.truth[frames].poses_se3, atol=1e-12)
    assert len(scene.calibration_fixes) == len(split.calibration)
    described = extract_local_features(sequence.image(int(split.calibration[3])), sequence.camera)
    for one, other in zip(scene.calibration_fixes[3], scene.region_landmarks.fixes(described), strict=True):
        np.testing.assert_array_equal(one.position_xyz, other.position_xyz)


def test_regions_with_landmarks_are_smaller_and_as_sure(model, sequence, small_world):
    cache = FeatureCache(small_world.cache)
    run = VisualOdometry(model).process(sequence, model.split.test, cache=cache)
    blind = load_model_without_landmarks(model)
    plain = VisualOdometry(blind).process(sequence, model.split.test, cache=cache)
    truth = sequence.truth[model.split.test]
    with_fixes, without = (RegionStatistics.of(r.regions, truth, model.sign_reference, r.kinds) for r in (run, plain))
    # a corridor that repeats itself: no single fix is trusted, but the region rests on all of them
    assert np.isin(run.kinds, [EvidenceKind.UNMATCHED, EvidenceKind.LANDMARKS]).mean() > 0.9
    assert np.isin(plain.kinds, [EvidenceKind.GLOBAL, EvidenceKind.UNKNOWN]).all()
    assert np.median(with_fixes.length[:, :3].sum(axis=1)) < 0.7 * np.median(without.length[:, :3].sum(axis=1))
    for tally, which in ((with_fixes, model), (without, blind)):
        table = coverage_table(tally, which, exchangeable=True)
        low, high = table["joint_band_99"]
        assert low <= table["joint_coverage"] <= high
    # the scores say the same as the sets
    features = extract_features([sequence.image_paths[i] for i in run.frames], model.backbone, cache)
    scores = model.scores(model.proba(features), pose_targets(truth, model.sign_reference), run.fixes)
    np.testing.assert_array_equal(scores <= model.rules.thresholds(run.kinds), with_fixes.inside)


def test_frames_without_a_look_for_landmarks_have_the_softmaxs_regions(model, sequence):
    blind = load_model_without_landmarks(model)
    frames = range(60, 64)

    def answered(which, **options):
        odometry = VisualOdometry(which, **options)
        return [odometry.step(sequence.image(i), sequence.timestamps_s[i]) for i in frames]

    seldom = answered(model, match_every=2)
    every, second, none = ([e.region for e in its] for its in (answered(model), seldom, answered(blind)))
    assert [e.evidence is EvidenceKind.GLOBAL for e in seldom] == [False, True, False, True]
    for k in (0, 2):
        np.testing.assert_array_equal(second[k].length, every[k].length)
    for k in (1, 3):
        np.testing.assert_allclose(second[k].length, none[k].length)
        assert second[k].n_intervals.tolist() == none[k].n_intervals.tolist()
    assert len(type(every[0]).concatenate(second)) == 4  # one grid for both kinds
    tally = RegionStatistics.concatenate(
        [
            RegionStatistics.of(e.region, sequence.truth[60:61], model.sign_reference, np.array([e.evidence]))
            for e in seldom
        ]
    )
    table = coverage_table(tally, model, exchangeable=True, matched_all=False)
    assert "two calibrations" in table["assumption"]
    assert all("band_99" not in row for row in table["targets"].values())


def test_recalibration_reaches_both_kinds_of_regions(model):
    other = replace(model)
    other.recalibrate(0.5)
    assert (other.calibration.thresholds_ <= model.calibration.thresholds_).all()
    kind = np.array([EvidenceKind.UNMATCHED])
    assert (other.rules.thresholds(kind) < model.rules.thresholds(kind)).any()


def test_one_threshold_for_all_targets_survives_saving(sequence, scene, small_world, tmp_path):
    config = ModelConfig(joint="max", score="linear_density", finders=1, training=TrainingConfig(epochs=1))
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    trained = train_model(data, config, scene=scene)
    save_model(trained, tmp_path)
    back = load_model(tmp_path)
    kinds = np.array(list(EvidenceKind))
    np.testing.assert_array_equal(back.rules.thresholds(kinds), trained.rules.thresholds(kinds))
    proba, image = trained.proba(data.features[:3]), measure_motions(sequence, np.arange(3)).described
    fixes = [trained.fixes(image[i]) for i in range(3)]
    one, other = trained.regions(proba, fixes), back.regions(proba, fixes)
    np.testing.assert_array_equal(one.length, other.length)
    assert trained.regions(proba).bins.sizes == one.bins.sizes


def test_regions_do_not_depend_on_how_many_are_worked_out_at_a_time(model, sequence, small_world, monkeypatch):
    frames = model.split.test[:20]
    cache = FeatureCache(small_world.cache)
    proba = model.proba(extract_features([sequence.image_paths[i] for i in frames], model.backbone, cache))
    described = measure_motions(sequence, frames).described
    fixes = [model.fixes(described[i]) for i in frames.tolist()]
    targets = pose_targets(sequence.truth[frames], model.sign_reference)
    at_once = model.regions(proba, fixes), model.scores(proba, targets, fixes)
    monkeypatch.setattr("conformodal.odometry.model._FRAMES_AT_A_TIME", 7)
    in_parts = model.regions(proba, fixes), model.scores(proba, targets, fixes)
    for one, other in zip(at_once[0].masks, in_parts[0].masks, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(at_once[1], in_parts[1])


def test_a_lone_training_recording_has_landmarks_for_the_region(sequence):
    n = len(sequence)
    apart = replace(sequence, recording=3 * np.arange(n) // n)
    split = make_split(apart.recording, "recordings")
    assert len(np.unique(apart.recording[split.train])) == 1
    assert learn_scene(apart, split).region_landmarks is not None
