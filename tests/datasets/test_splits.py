import numpy as np
import pytest

from conformodal.datasets import SplitError, SplitKind, hold_out, make_split


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


def test_blocks_held_out_once_more_are_whole_stretches_without_gaps():
    frames = np.concatenate((np.arange(0, 90), np.arange(100, 160), np.arange(300, 310)))
    recording = (np.arange(400) >= 40).astype(int)
    kept, held = hold_out(frames, recording, SplitKind.BLOCKS, 0.25, seed=1, n_blocks=16)
    assert sorted([*kept, *held]) == frames.tolist()
    # 160 frames in pieces of at most 10, cut where the recording changes and where frames are missing
    runs = np.split(held, np.flatnonzero(np.diff(held) != 1) + 1)
    assert all(run[0] % 10 == 0 and (run[-1] + 1) % 10 == 0 for run in runs)
    assert len(held) == 40
    np.testing.assert_array_equal(held, hold_out(frames, recording, SplitKind.BLOCKS, 0.25, seed=1, n_blocks=16)[1])


def test_frames_held_out_once_more_are_single():
    kept, held = hold_out(np.arange(0, 200, 2), np.zeros(200, int), SplitKind.INTERLEAVED, 0.25)
    assert len(held) == 25
    assert (np.diff(held) > 2).any()
    assert not set(kept) & set(held)
    with pytest.raises(SplitError, match="too few to hold some out"):
        hold_out(np.array([4]), np.zeros(9, int), SplitKind.INTERLEAVED, 0.25)
