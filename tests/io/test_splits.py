import numpy as np
import pytest

from conformodal.io import SplitError, SplitKind, held_out_together, make_split


@pytest.mark.parametrize("kind", ["interleaved", "blocks"])
def test_parts_are_disjoint_whole_and_seeded(kind):
    recording = np.repeat([0, 1], [700, 300])
    split = make_split(recording, kind, seed=4)
    together = np.concatenate((split.train, split.calibration, split.test))
    assert sorted(together.tolist()) == list(range(1000))
    assert abs(len(split.test) - 200) <= (40 if kind == "blocks" else 0)
    again, other = make_split(recording, kind, seed=4), make_split(recording, kind, seed=5)
    assert again.test.tolist() == split.test.tolist() != other.test.tolist()


def test_blocks_are_contiguous_and_do_not_span_recordings():
    recording = np.repeat([0, 1], [505, 495])
    split = make_split(recording, "blocks")
    runs = np.split(split.test, np.flatnonzero(np.diff(split.test) > 1) + 1)
    assert max(len(r) for r in runs) >= 40
    assert len(runs) <= 6


@pytest.mark.parametrize("kind", ["interleaved", "blocks"])
def test_less_data_leaves_the_test_part_as_it_is(kind):
    recording = np.zeros(1000, int)
    whole = make_split(recording, kind, seed=2)
    less = make_split(recording, kind, seed=2, calibration=0.08, used=0.4)
    assert less.test.tolist() == whole.test.tolist()
    assert len(less.train) + len(less.calibration) == pytest.approx(400, abs=40)
    assert len(less.calibration) == pytest.approx(80, abs=40)
    same = make_split(recording, kind, seed=2, used=0.8)
    assert same.train.tolist() == whole.train.tolist()


@pytest.mark.parametrize("kind", [SplitKind.INTERLEAVED, SplitKind.BLOCKS])
def test_frames_held_out_together_are_in_the_same_part(kind):
    recording = np.repeat([0, 1], [130, 270])
    piece = held_out_together(recording, kind)
    split = make_split(recording, kind, seed=3)
    for part in (split.train, split.calibration, split.test):
        inside = np.isin(np.arange(400), part)
        assert not set(piece[inside]) & set(piece[~inside])
    assert not set(piece[recording == 0]) & set(piece[recording == 1])
    assert len(np.unique(piece)) == (400 if kind is SplitKind.INTERLEAVED else 26)


SEVEN = np.repeat([0, 1, 2, 5, 6, 7, 8], [30, 10, 20, 40, 15, 25, 60])


def recordings_of(split, recording):
    return [set(recording[part].tolist()) for part in (split.train, split.calibration, split.test)]


@pytest.mark.parametrize("seed", range(5))
def test_no_recording_is_in_two_parts(seed):
    split = make_split(SEVEN, "recordings", seed=seed)
    train, calibration, test = recordings_of(split, SEVEN)
    assert (len(train), len(calibration), len(test)) == (5, 1, 1)
    assert train | calibration | test == set(SEVEN.tolist())
    together = np.concatenate((split.train, split.calibration, split.test))
    assert sorted(together.tolist()) == list(range(200))


@pytest.mark.parametrize(
    ("n", "shares", "expected"),
    [
        (3, {}, (1, 1, 1)),
        (10, {}, (6, 2, 2)),
        (10, {"used": 0.4, "calibration": 0.08}, (3, 1, 2)),
        (4, {"test": 0.49, "calibration": 0.49}, (1, 1, 2)),
        (4, {"used": 0.2}, (1, 1, 1)),
        (3, {"test": 0.9, "calibration": 0.05}, (1, 1, 1)),
    ],
)
def test_every_part_gets_a_recording(n, shares, expected):
    recording = np.repeat(np.arange(n), 5)
    parts = recordings_of(make_split(recording, "recordings", **shares), recording)
    assert tuple(len(p) for p in parts) == expected


@pytest.mark.parametrize("seed", range(5))
def test_given_split_tests_on_the_listed_recordings(seed):
    """It calibrates on other recordings."""
    given_test = np.isin(SEVEN, [1, 5])
    split = make_split(SEVEN, "given", seed=seed, given_test=given_test)
    assert split.test.tolist() == np.flatnonzero(given_test).tolist()
    train, calibration, test = recordings_of(split, SEVEN)
    assert test == {1, 5}
    assert (len(train), len(calibration)) == (4, 1)
    assert train | calibration == {0, 2, 6, 7, 8}


@pytest.mark.parametrize("kind", ["blocks", "recordings", "given"])
def test_random_calibration_draws_from_every_recording(kind):
    from conformodal.io import with_random_calibration

    recording = np.repeat(np.arange(3), 200)
    split = make_split(recording, kind, seed=4, given_test=recording == 2)
    drawn = with_random_calibration(split, 0.2)
    assert drawn.test.tolist() == split.test.tolist()
    both = np.sort(np.concatenate((split.train, split.calibration)))
    assert np.sort(np.concatenate((drawn.train, drawn.calibration))).tolist() == both.tolist()
    assert len(drawn.calibration) == round(0.2 * len(both))
    for number in np.unique(recording[both]):
        share = np.isin(both[recording[both] == number], drawn.calibration).mean()
        assert share == pytest.approx(0.2, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "options", "match"),
    [
        ("random", {}, "interleaved"),
        ("blocks", {"test": 0.9, "calibration": 0.2}, "leave something to train on"),
        ("interleaved", {"used": 0.1}, "used"),
        ("interleaved", {"used": 0.16}, "used"),
        ("interleaved", {"used": 0.9}, "used"),
        ("recordings", {}, "at least 3 recordings.*found 1"),
        ("given", {}, r"TrainSplit\.txt and TestSplit\.txt"),
        ("given", {"given_test": np.zeros(100, bool)}, "too few"),
        ("given", {"given_test": np.ones(100, bool)}, "too few"),
        ("given", {"given_test": np.arange(100) > 0}, "too few"),
    ],
)
def test_impossible_splits_are_refused(kind, options, match):
    with pytest.raises(SplitError, match=match):
        make_split(np.zeros(100, int), kind, **options)
