"""Extending a model: each recording is a test first, then calibrates, then joins the map."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from conformodal.conformal import ConformodalError
from conformodal.corridor import CorridorWorld, Renderer, drone_path, write_flight
from conformodal.features.extract import FeatureCache
from conformodal.io import read_recording
from conformodal.io.recording import join_recordings
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.evaluate import RegionStatistics
from conformodal.pipeline.extend import extend_model
from conformodal.pipeline.guarantee import describe_guarantee
from conformodal.pipeline.model import PATHS
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import train_model
from conformodal.pipeline.whole_recordings import describe_units
from tests.helpers import few_left_out, refusal, run_ok

pytestmark = pytest.mark.slow

N_FRAMES = 110  # of a flight


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Folders of three flights in one corridor."""
    world, folders = CorridorWorld(2, seed=5), []
    for seed in (5, 6, 7):
        folders.append(tmp_path_factory.mktemp("flights") / f"flight-{seed}")
        poses = drone_path(world, 1, seed).poses_se3[:N_FRAMES]
        write_flight(folders[-1] / "seq-01", Renderer(world), poses, noise_seed=seed * 1_000_003)
    return folders


@pytest.fixture(scope="module")
def recordings(flights):
    return [read_recording(folder) for folder in flights]


@pytest.fixture(scope="module")
def trained(recordings):
    config = ModelConfig(sources=("neighbours", "landmarks"), alpha=0.2)
    with few_left_out():
        return train_model(recordings[0], config, cache=FeatureCache(None))


@pytest.fixture(scope="module")
def extended(trained, recordings):
    return extend_model(trained, recordings[1:2])


@pytest.fixture(scope="module")
def without_poses(recordings):
    """The second recording; its poses are not known."""
    return replace(recordings[1], poses=None)


@pytest.fixture(scope="module")
def answered(trained, without_poses):
    return VisualOdometry(trained).process(without_poses)


@pytest.fixture(scope="module")
def taught(trained, without_poses):
    """The model with the reliable frames of the second recording, at its own answers."""
    return extend_model(trained, [without_poses])


def test_a_recording_is_tested_before_it_joins(trained, recordings, extended):
    """As a run of the model does, with the same coverage and the same scores."""
    [entry] = extended.journal
    run = VisualOdometry(trained).process(recordings[1])
    truth = recordings[1].require_truth()[run.frames]
    held = RegionStatistics.of(run.regions, truth, trained.sign_reference).held
    assert entry.n_frames == len(recordings[1])
    assert entry.coverage == pytest.approx(held.mean(), abs=0.02)
    assert entry.reliable == pytest.approx(np.mean([one.reliable for one in run.estimates]), abs=0.05)
    added = extended.calibration.scores_[trained.n_calibration :]
    threshold = np.array([trained.rules.thresholds(run.localization.kinds)]).reshape(-1, 7)
    assert (added <= threshold).all(axis=1).mean() == pytest.approx(held.mean(), abs=0.02)


def test_its_scores_calibrate_in_stretches_as_long_as_the_others(trained, extended, recordings):
    n = len(recordings[1])
    units, before = extended.calibration.units_, trained.calibration.units_
    np.testing.assert_array_equal(units[: len(before)], before)
    labels, sizes = np.unique(units[len(before) :], return_counts=True)
    assert sizes.sum() == n
    assert labels.min() > before.max()
    usual = np.median(np.unique(before, return_counts=True)[1])
    assert abs(np.median(sizes) - usual) <= 1
    [entry] = extended.journal
    assert (entry.first_unit, entry.n_units) == (labels[0], len(labels))
    for path in PATHS:
        rule, old = extended.path_rules[path].calibration, trained.path_rules[path].calibration
        np.testing.assert_array_equal(rule.scores_[: len(old.scores_)], old.scores_)
        assert len(old.scores_) < len(rule.scores_) <= len(old.scores_) + n
        assert set(rule.units_[len(old.scores_) :]) <= set(labels)


def test_then_it_is_known(trained, extended, recordings):
    numbers = np.arange(len(trained.known_frames), len(extended.known_frames))
    assert len(numbers) == len(recordings[1])
    for source, before in zip(extended.localizer.sources, trained.localizer.sources, strict=True):
        np.testing.assert_array_equal(source.frames, np.concatenate((before.frames, numbers)))
    np.testing.assert_array_equal(extended.split.test, trained.split.test)
    assert set(numbers) <= set(extended.split.calibration)
    again = VisualOdometry(extended).process(recordings[1])
    before = VisualOdometry(trained).process(recordings[1])
    truth = recordings[1].require_truth()[again.frames].positions_xyz
    errors = [np.linalg.norm(run.trajectories["online"].positions_xyz - truth, axis=1) for run in (again, before)]
    assert np.median(errors[0]) < np.median(errors[1])


def test_an_extended_model_is_stored(extended, recordings, flights, tmp_path):
    model = tmp_path / "model"
    save_model(extended, model)
    loaded = load_model(model)
    assert loaded.journal == extended.journal
    assert extended.journal[0].describe() in run_ok("info", model).output
    run_ok("run", model, flights[2], "--out", tmp_path / "run")
    [entry] = json.loads((tmp_path / "run" / "metrics.json").read_text(encoding="utf-8"))["journal"]
    assert entry["name"] == extended.journal[0].name
    assert "Recordings that joined" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    run, other = (VisualOdometry(one).process(recordings[2], np.arange(12)) for one in (loaded, extended))
    np.testing.assert_array_equal(run.trajectories["online"].positions_xyz, other.trajectories["online"].positions_xyz)


def test_the_guarantee_says_what_is_assumed(trained, extended):
    assert "exchangeable in the order in which they came" in describe_guarantee(extended)
    assert "joined after training" not in describe_guarantee(trained)
    assert describe_units(extended).startswith("Stretches calibrate")


def test_a_recording_is_refused_twice(extended, recordings):
    with pytest.raises(ConformodalError, match=r"flight-6.*images are in the model already"):
        extend_model(extended, recordings[1:2])


def test_what_cannot_extend_a_model_is_refused(trained, recordings):
    one = recordings[1]
    with pytest.raises(ConformodalError, match="60 frames without a pose; a recording needs one for each, or none"):
        extend_model(trained, [replace(one, poses=one.poses[: N_FRAMES - 60])])
    other = replace(one, camera=replace(one.camera, fx=2 * one.camera.fx))
    with pytest.raises(ConformodalError, match="is from another camera"):
        extend_model(trained, [other])
    away = replace(one.poses, positions_xyz=one.poses.positions_xyz + 1000)
    with pytest.raises(ConformodalError, match="far beyond those of the model"):
        extend_model(trained, [replace(one, poses=away)])
    with pytest.raises(ConformodalError, match="lengths in units"):
        extend_model(trained, [replace(one, unit="units")])


def test_the_command_tests_then_teaches(trained, flights, tmp_path):
    save_model(trained, tmp_path / "model")
    cache = "--cache", tmp_path / "cache"
    result = run_ok("extend", tmp_path / "model", *flights[1:], "--out", tmp_path / "grown", *cache)
    assert result.output.count("before it joined: regions held") == 2
    grown = load_model(tmp_path / "grown")
    assert [entry.n_frames for entry in grown.journal] == [len(read_recording(folder)) for folder in flights[1:]]
    told = refusal("extend", tmp_path / "model", flights[1], "--out", tmp_path / "grown", *cache)
    assert "holds a model already" in told
    told = refusal("extend", tmp_path / "grown", flights[2], "--out", tmp_path / "more", *cache)
    assert "are in the model already" in told
    assert not (tmp_path / "more" / "model.json").exists()


def test_a_folder_of_several_recordings_is_refused(trained, recordings):
    with pytest.raises(ConformodalError, match="holds 2 recordings; give the folder of each"):
        extend_model(trained, [join_recordings(recordings[1:])])


def test_reliable_frames_join_at_estimated_poses(trained, taught, answered):
    reliable, n_known = answered.reliable, len(trained.known_frames)
    assert 10 <= reliable.sum() < len(reliable)
    poses = taught.known_frames.poses[n_known:]
    expected = answered.trajectory[np.flatnonzero(reliable)]
    np.testing.assert_allclose(poses[reliable, :3], expected.positions_xyz, atol=1e-12)
    np.testing.assert_allclose(poses[reliable, 3:], expected.orientations_quat_wxyz, atol=1e-12)
    assert np.isnan(poses[~reliable]).all()
    numbers = n_known + np.flatnonzero(reliable)
    for source, before in zip(taught.localizer.sources, trained.localizer.sources, strict=True):
        np.testing.assert_array_equal(source.frames, np.concatenate((before.frames, numbers)))
        assert source.errors == before.errors
    assert len(taught.landmarks.map.points_xyz) > len(trained.landmarks.map.points_xyz)
    np.testing.assert_array_equal(taught.landmarks.held_out, trained.landmarks.held_out)
    every = np.arange(n_known, len(taught.known_frames))
    assert len(every) == len(answered.frames)
    np.testing.assert_array_equal(taught.split.train, np.concatenate((trained.split.train, every)))
    np.testing.assert_array_equal(taught.split.calibration, trained.split.calibration)


def test_a_recording_without_poses_calibrates_nothing(trained, taught):
    assert taught.rules.by_type.keys() == trained.rules.by_type.keys()
    for kind, rule in trained.rules.by_type.items():
        np.testing.assert_array_equal(taught.rules.by_type[kind].thresholds_, rule.thresholds_)
    np.testing.assert_array_equal(taught.calibration.scores_, trained.calibration.scores_)
    np.testing.assert_array_equal(taught.calibration.units_, trained.calibration.units_)
    for path in PATHS:
        rule, before = taught.path_rules[path].calibration, trained.path_rules[path].calibration
        np.testing.assert_array_equal(rule.thresholds_, before.thresholds_)
        np.testing.assert_array_equal(rule.scores_, before.scores_)
    for test, before in (
        (taught.novelty.test, trained.novelty.test),
        (taught.novelty.matched, trained.novelty.matched),
    ):
        np.testing.assert_array_equal(test.references, before.references)
        np.testing.assert_array_equal(test.scores_, before.scores_)
        np.testing.assert_array_equal(test.units_, before.units_)
    assert "calibrate nothing" in describe_guarantee(taught)


def test_what_joined_without_poses_is_known_better(trained, taught, answered, recordings):
    again = VisualOdometry(taught).process(recordings[1])
    truth = recordings[1].require_truth()[again.frames].positions_xyz
    errors = [np.linalg.norm(run.trajectories["online"].positions_xyz - truth, axis=1) for run in (again, answered)]
    assert np.median(errors[0]) < np.median(errors[1])
    assert again.reliable.mean() > 0.5


def test_the_journal_says_that_there_were_no_poses(taught, answered, flights, tmp_path):
    [entry] = taught.journal
    n, n_reliable = len(answered.frames), int(answered.reliable.sum())
    assert (entry.coverage, entry.path_coverage, entry.median_m, entry.n_units) == (None, None, None, 0)
    assert entry.bounded == np.mean(~answered.regions.unbounded.any(axis=1))
    said = f"{n} frames, no poses: joined the map alone, with {n_reliable} reliable frames"
    assert said in entry.describe()
    assert f"the other {n - n_reliable} joined nothing" in entry.describe()
    save_model(taught, tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    assert loaded.journal == taught.journal
    np.testing.assert_array_equal(loaded.known_frames.poses, taught.known_frames.poses)
    assert entry.describe() in run_ok("info", tmp_path / "model").output
    run_ok("run", tmp_path / "model", flights[2], "--limit", "3", "--out", tmp_path / "run")
    [written] = json.loads((tmp_path / "run" / "metrics.json").read_text(encoding="utf-8"))["journal"]
    assert written["coverage"] is None
    assert "no poses: joined the map alone" in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")


def test_unusable_recordings_without_poses_are_refused(trained, taught, without_poses):
    with pytest.raises(ConformodalError, match=r"flight-6.*images are in the model already"):
        extend_model(taught, [without_poses])
    other = replace(without_poses.camera, fx=2 * without_poses.camera.fx)
    with pytest.raises(ConformodalError, match="is from another camera"):
        extend_model(trained, [replace(without_poses, camera=other)])


def test_too_few_reliable_frames_are_refused(trained, without_poses):
    """Nine frames are, even if all are reliable."""
    few = slice(None, 9)
    short = {"image_paths": without_poses.image_paths[few], "recording": without_poses.recording[few]}
    short = replace(without_poses, timestamps_s=without_poses.timestamps_s[few], **short)
    with pytest.raises(ConformodalError, match=r"no poses, and \d of 9 frames \(\d+ %\) .* expected 10 or more; begin"):
        extend_model(trained, [short])


def as_video(recording, path, n=80, size=None):
    """The frames of a recording as a video without a loss."""
    images = [recording.image(i) for i in range(n)]
    images = images if size is None else [cv2.resize(image, size) for image in images]
    size = images[0].shape[1::-1]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 30.0, size)
    for image in images:
        video.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    video.release()
    return path


def test_the_command_takes_videos_and_folders_without_poses(trained, recordings, flights, tmp_path):
    save_model(trained, tmp_path / "model")
    video, folder = as_video(recordings[1], tmp_path / "walk.avi"), tmp_path / "images"
    folder.mkdir()
    for i, path in enumerate(recordings[2].image_paths[:80]):
        (folder / f"{i:03d}.png").write_bytes(path.read_bytes())
    cache = "--cache", tmp_path / "cache"
    result = run_ok("extend", tmp_path / "model", video, folder, "--out", tmp_path / "grown", *cache)
    assert result.output.count("80 frames, no poses: joined the map alone") == 2
    assert "taken for the model's camera" in result.output
    assert [entry.name for entry in load_model(tmp_path / "grown").journal] == ["walk.avi", "images"]
    assert not list((tmp_path / "grown").rglob("*.png"))
    told = refusal("extend", tmp_path / "grown", video, "--out", tmp_path / "more", *cache)
    assert "80 of its 80 images are in the model already" in told
    small = as_video(recordings[2], tmp_path / "small.avi", n=12, size=(80, 60))
    told = refusal("extend", tmp_path / "model", small, "--out", tmp_path / "more", *cache)
    expected = f"{trained.camera.width}x{trained.camera.height}"
    assert f"small.avi: has images of 80x60 pixels, expected the model's {expected}" in told
    assert not (tmp_path / "more").exists()
