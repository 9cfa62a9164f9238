"""Exact order statistics of scores that come in chunks."""

import numpy as np
import pytest

from conformodal.conformal import ConformodalError, OnlineConformal, QuantileBins, SplitConformal
from conformodal.conformal.streams import ScoreStream

BINS = QuantileBins.from_edges([[0, 1, 2, 3], [0, 1, 2]])


def chunked(scores, size=7):
    return lambda: (scores[i : i + size] for i in range(0, len(scores), size))


@pytest.mark.parametrize("kind", ["normal", "ties", "wide", "close", "float32"])
def test_every_rank_is_that_of_sorting(kind):
    rng = np.random.default_rng(0)
    scores = {
        "normal": rng.normal(size=300),
        "ties": rng.integers(-2, 3, 300) * 0.5,
        "wide": rng.standard_cauchy(300) * 10.0 ** rng.integers(-300, 300, 300),
        "close": 1 + rng.integers(0, 50, 300) * 2.0**-52,
        "float32": rng.normal(size=300).astype(np.float32),
    }[kind]
    scores[:3] = np.inf, -np.inf, -0.0
    more = np.sort(rng.choice(scores, 40).astype(float))
    stream = ScoreStream(chunked(scores))
    assert stream.dtype == scores.dtype
    assert [stream.smallest(k) for k in range(1, 301)] == np.sort(scores).tolist()
    both = np.sort([*scores, *more])
    assert [stream.smallest(k, others=more) for k in range(1, 341, 13)] == both[::13].tolist()


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_thresholds_of_a_source_are_those_of_the_array(tmp_path, joint):
    rng = np.random.default_rng(1)
    scores = rng.normal(size=(999, 2)).astype(np.float32)
    whole, parts, mapped = (SplitConformal(BINS, joint=joint).set_scale([1, 2.0]) for _ in range(3))
    np.save(tmp_path / "scores.npy", scores)
    whole.calibrate_scores(scores)
    parts.calibrate_scores(chunked(scores))
    mapped.calibrate_scores(np.load(tmp_path / "scores.npy", mmap_mode="r"))
    for other in (parts, mapped):
        assert other.n_units == 999
        np.testing.assert_array_equal(other.thresholds_, whole.thresholds_)
        for alpha in ("0.3", "0.0001"):
            np.testing.assert_array_equal(other.at(alpha).thresholds_, whole.at(alpha).thresholds_)


@pytest.mark.parametrize("window", [None, 50])
def test_online_thresholds_match_after_streamed_scores(window):
    rng = np.random.default_rng(2)
    past, new = rng.random((200, 2)), rng.random((80, 2))
    begun = OnlineConformal(BINS, window=window).begin(chunked(past))
    whole = OnlineConformal(BINS, window=window)
    for tracker, column in zip(whole.trackers, past.T, strict=True):
        for score in column:
            tracker.past.add(score)
    for row in new:
        np.testing.assert_array_equal(begun.thresholds, whole.thresholds)
        for one in (begun, whole):
            for tracker, score in zip(one.trackers, row, strict=True):
                tracker.update(score)


def test_what_cannot_be_read_again_or_changes_is_refused():
    scores = np.random.default_rng(3).random((100, 2))
    split = SplitConformal(BINS)
    for calibrate in (split.calibrate_scores, OnlineConformal(BINS).begin):
        with pytest.raises(ConformodalError, match="read several times"):
            calibrate(iter([scores]))
        with pytest.raises(ConformodalError, match="NaN"):
            calibrate(lambda: [scores * np.nan])
        with pytest.raises(ConformodalError, match="shape"):
            calibrate(lambda: [scores[:, 0]])
        with pytest.raises(ConformodalError, match="at least one"):
            calibrate(lambda: [])
    with pytest.raises(ConformodalError, match="units must be None"):
        split.calibrate_scores(lambda: [scores], units=np.arange(100))
    reads = iter([scores, scores + 1])
    with pytest.raises(ConformodalError, match="have changed"):
        split.calibrate_scores(lambda: [next(reads)])
