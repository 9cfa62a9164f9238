import numpy as np
import pytest

from conformodal.datasets import SplitError, SplitKind, held_out_together, make_split


@pytest.mark.parametrize("kind", ["interleaved", "blocks"])
def test_parts_are_disjoint_whole_and_seeded(kind):
    recording = np.repeat([0, 1], [700, 300])
    split = make_split(recording, kind, seed=4)
    together = np.concatenate((split.train, split.calibration, split.test))
    assert sorted(together.tolist()) == list(range(1000))
    assert abs(len(split.test) - 200) <= 40
    again, other = make_split(recording, kind, seed=4), make_split(recording, kind, seed=5)
    assert again.test.tolist() == split.test.tolist() != other.test.tolist()


def test_shares_of_an_interleaved_split_are_exact():
    split = make_split(np.zeros(1000, int), "interleaved", test=0.2, calibration=0.16)
    assert (len(split.train), len(split.calibration), len(split.test)) == (640, 160, 200)


def test_blocks_are_contiguous_and_do_not_span_recordings():
    recording = np.repeat([0, 1], [505, 495])
    split = make_split(recording, "blocks", n_blocks=20)
    runs = np.split(split.test, np.flatnonzero(np.diff(split.test) > 1) + 1)
    assert max(len(r) for r in runs) >= 40
    assert len(runs) <= 6


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: make_split(np.zeros(100, int), "random"), "interleaved"),
        (lambda: make_split(np.zeros(100, int), "blocks", test=0.9, calibration=0.2), "shares"),
        (lambda: make_split(np.zeros(3, int), "interleaved"), "too few"),
    ],
)
def test_impossible_splits_are_refused(call, match):
    with pytest.raises(SplitError, match=match):
        call()


def test_unknown_part():
    with pytest.raises(SplitError, match="part"):
        make_split(np.zeros(100, int), "blocks").part("validation")


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


@pytest.mark.parametrize("used", [0.1, 0.16, 0.9])
def test_shares_that_do_not_fit_are_refused(used):
    with pytest.raises(SplitError, match="used"):
        make_split(np.zeros(100, int), "interleaved", used=used)


@pytest.mark.parametrize("kind", [SplitKind.INTERLEAVED, SplitKind.BLOCKS])
def test_frames_held_out_together_are_in_the_same_part(kind):
    recording = np.repeat([0, 1], [130, 270])
    piece = held_out_together(recording, kind, n_blocks=20)
    split = make_split(recording, kind, seed=3, n_blocks=20)
    for part in (split.train, split.calibration, split.test):
        inside = np.isin(np.arange(400), part)
        assert not set(piece[inside]) & set(piece[~inside])
    assert not set(piece[recording == 0]) & set(piece[recording == 1])
    assert len(np.unique(piece)) == (400 if kind is SplitKind.INTERLEAVED else 21)
