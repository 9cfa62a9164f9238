from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.datasets import make_split
from conformodal.model.config import Calibration
from conformodal.training.folds import make_folds


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
    _, split, folds = parts_of(sizes, kind, Calibration.STRETCHES, seed=seed)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    assert len(folds.folds) == 5
    np.testing.assert_array_equal(np.sort(folds.held_out), used)  # each is held out once
    np.testing.assert_array_equal(folds.region_frames, used)
    for fold in folds.folds:
        np.testing.assert_array_equal(np.sort(np.concatenate((fold.train, fold.held_out))), used)
        assert not np.isin(folds.units[fold.train], folds.units[fold.held_out]).any()
        assert (np.diff(fold.train) > 0).all()
        assert not np.isin(split.test, fold.train).any()
        assert not np.isin(split.test, fold.held_out).any()
    np.testing.assert_array_equal(folds.pieces, folds.units)


def test_stretches_are_whole_and_of_one_recording():
    sequence, _, folds = parts_of([200, 130], "interleaved", Calibration.STRETCHES)
    for unit in np.unique(folds.units):
        its = np.flatnonzero(folds.units == unit)
        assert (np.diff(its) == 1).all()
        assert len(np.unique(sequence.recording[its])) == 1


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
    assert len(folds.folds) == (1 if by_frame else 5)


def test_folds_are_those_of_the_seed():
    one, same, other = (
        parts_of([300], "blocks", Calibration.STRETCHES, seed=seed)[2].folds[0].held_out for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
