"""What is learnt from: folds of frames and stretches, the depth of the scene, and the untuned regressor."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.features.local import ORB
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import matrix_from_quat_wxyz
from conformodal.io import Recording, Split, SplitKind, make_split, read_recording
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.config import Calibration
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.folds import make_folds
from conformodal.pipeline.plain import train_plain
from conformodal.pipeline.store import load_model, save_model
from conformodal.tracking.depths import UNKNOWN_DEPTH, match_depth, track_depth


def recorded(sizes):
    """What folds ask of a sequence."""
    return SimpleNamespace(recording=np.repeat(np.arange(len(sizes)), sizes), given_test=None)


def parts_of(sizes, kind, calibration, **options):
    sequence = recorded(sizes)
    split = make_split(sequence.recording, kind, **options)
    return sequence, split, make_folds(sequence, split, calibration)


def test_frames_are_the_training_and_the_calibration_part():
    _, split, folds = parts_of([120], "interleaved", Calibration.FRAMES)
    (fold,) = folds.folds
    np.testing.assert_array_equal(fold.train, split.train)
    np.testing.assert_array_equal(fold.held_out, split.calibration)
    np.testing.assert_array_equal(folds.region_frames, split.train)
    np.testing.assert_array_equal(folds.held_out, split.calibration)
    assert folds.units is None
    assert len(np.unique(folds.pieces)) == 120  # every frame is new by itself


@pytest.mark.parametrize("sizes", [[300], [200, 130], [30] * 12])
@pytest.mark.parametrize("kind", ["interleaved", "blocks"])
@pytest.mark.parametrize("seed", [0, 1])
def test_stretches_part_the_used_frames(sizes, kind, seed):
    sequence, split, folds = parts_of(sizes, kind, Calibration.STRETCHES, seed=seed)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    assert len(folds.folds) == 4
    np.testing.assert_array_equal(np.sort(folds.held_out), used)  # each is held out once
    np.testing.assert_array_equal(folds.region_frames, used)
    for fold in folds.folds:
        np.testing.assert_array_equal(np.sort(np.concatenate((fold.train, fold.held_out))), used)
        assert not np.isin(folds.units[fold.train], folds.units[fold.held_out]).any()
        assert (np.diff(fold.train) > 0).all()
        assert not np.isin(split.test, fold.train).any()
        assert not np.isin(split.test, fold.held_out).any()
    for unit in np.unique(folds.units):  # whole stretches of one recording
        its = np.flatnonzero(folds.units == unit)
        assert (np.diff(its) == 1).all()
        assert len(np.unique(sequence.recording[its])) == 1
    np.testing.assert_array_equal(folds.pieces, folds.units)


@pytest.mark.parametrize(("n_recordings", "whole"), [(8, False), (9, True), (12, True)])
def test_nine_recordings_are_enough_to_be_the_units(n_recordings, whole):
    # one of each more that tests: what counts is what is used
    sequence, split, folds = parts_of([40] * (n_recordings + 1), "recordings", Calibration.STRETCHES, test=0.08)
    used = np.concatenate((split.train, split.calibration))
    assert len(np.unique(sequence.recording[used])) == n_recordings
    assert np.array_equal(folds.units, sequence.recording) == whole


@pytest.mark.parametrize(("kind", "by_frame"), [("interleaved", True), ("blocks", False), ("recordings", False)])
def test_auto_asks_frames_where_single_frames_are_held_out(kind, by_frame):
    *_, folds = parts_of([60] * 4, kind, Calibration.AUTO)
    assert (folds.units is None) == by_frame
    assert len(folds.folds) == (1 if by_frame else 4)


def made_up(n=300):
    """Poses that are linear in some features."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(n, 6 + 768)).astype(np.float32)
    targets = features[:, :6].astype(np.float64) @ rng.normal(size=(6, 7)) * [1, 2, 3, 0.1, 0.1, 0.1, 0] + 4
    parts = np.split(np.arange(n), [n // 3, 2 * n // 3])
    sequence = SimpleNamespace(recording=np.zeros(n, dtype=np.int64), given_test=None)
    split = Split(SplitKind.INTERLEAVED, 0, *parts)
    return TrainingData(sequence, split, features, targets, np.array([1.0, 0, 0, 0]))


def test_the_regressor_learns_from_no_test_frame():
    data, config = made_up(), TrainingConfig(epochs=15, hidden=32, dropout=0.0, input_dropout=0.0, components=None)
    regressor = train_plain(data, config)
    known = np.concatenate((data.split.train, data.split.calibration))
    np.testing.assert_allclose(regressor.mean, data.targets[known].mean(axis=0))
    for part in (data.split.calibration, data.split.test):
        off = (regressor.predict(data.features[part]) - data.targets[part])[:, :3]
        assert np.sqrt(np.mean(off**2)) < 0.5 * data.targets[:, :3].std()
    data.targets[data.split.test] += 100
    again = train_plain(data, config)
    np.testing.assert_array_equal(again.predict(data.features), regressor.predict(data.features))


def test_a_constant_target_yields_a_valid_trajectory():
    """Its quaternions have unit length, though those that the network predicts have not."""
    data, config = made_up(60), TrainingConfig(epochs=2, hidden=8, components=None)
    regressor = train_plain(data, config)
    path = regressor.trajectory(data.features, np.arange(60.0))
    np.testing.assert_allclose(regressor.predict(data.features)[:, 6], 4, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(path.orientations_quat_wxyz, axis=1), 1)
    np.testing.assert_array_equal(path.positions_xyz, regressor.predict(data.features)[:, :3])


def test_tracked_depths_of_redkitchen_are_plausible(redkitchen, monkeypatch):
    sequence, asked, read = read_recording(redkitchen), [], Recording.image
    monkeypatch.setattr(Recording, "image", lambda its, i: asked.append(i) or read(its, i))
    frames = np.sort(np.random.default_rng(0).choice(1000, 640, replace=False))
    depth = track_depth(sequence, frames)
    assert set(asked) <= set(frames.tolist())  # test frames are not looked at
    assert len(asked) <= 120
    assert 1.4 < depth.median_m < 2.6
    assert 0.1 <= depth.log_spread < 0.6
    for frames in (np.arange(4), np.array([5]), np.array([], dtype=np.int64), np.arange(0, 1000, 200)):
        assert track_depth(sequence, frames) == UNKNOWN_DEPTH


def test_matched_depth_agrees_with_tracked_depth(redkitchen):
    sequence = read_recording(redkitchen)
    sparse = np.arange(0, 1000, 30)
    assert track_depth(sequence, sparse) == UNKNOWN_DEPTH
    depth = match_depth(sequence, sparse, ORB)
    assert depth.median_m == pytest.approx(track_depth(sequence, np.arange(1000)).median_m, rel=0.25)
    assert 0.1 <= depth.log_spread < 0.6
    for frames in (np.arange(4), np.array([], dtype=np.int64)):  # neighbours have no parallax
        assert match_depth(sequence, frames, ORB) == UNKNOWN_DEPTH


def test_a_model_that_knows_no_depths_is_saved_and_answers(small_world, tmp_path):
    model = load_model(small_world.model)
    assert np.isfinite(model.prior.depth_m)
    model.prior = replace(model.prior, depth_m=np.nan, depth_spread=np.nan)
    save_model(model, tmp_path / "model")
    back = load_model(tmp_path / "model")
    assert np.isnan([back.prior.depth_m, back.prior.depth_spread]).all()
    sequence = read_recording(small_world.folder)
    run = VisualOdometry(back).process(sequence, np.arange(12))
    assert run.observations(np.arange(12)).submaps
    assert np.isfinite(run.trajectory.positions_xyz).all()


def test_submaps_stay_within_a_recording_and_name_its_frames(small_world, two_recordings):
    both = two_recordings
    n = len(both) // 2
    frames = np.arange(n - 40, n + 20)
    run = VisualOdometry.load(small_world.model).process(both, frames)
    assert (np.diff(run.recording) >= 0).all()
    first, second = (run.observations(rows).submaps for rows in (np.arange(40), np.arange(40, 60)))
    assert first
    assert second
    assert all(s.frames[-1] < 40 for s in first)
    assert all(s.frames[-1] < 20 for s in second)
    # the submaps' paths are those of the truth, but for their lengths
    truth, misses = both.require_truth()[frames[:40]], []
    for submap in first:
        places = truth.positions_xyz[submap.frames] - truth.positions_xyz[submap.frames[0]]
        path = submap.positions @ matrix_from_quat_wxyz(truth.orientations_quat_wxyz[submap.frames[:1]])[0].T
        length = (path * places).sum() / (path**2).sum()
        misses.append(np.sqrt(((length * path - places) ** 2).mean()) / (abs(length) * submap.sigma))
    assert np.median(misses) < 1
