"""Clocks of streams that jump, stop or repeat; and streams without an end, which take no more memory."""

import gc
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from conformodal.io.streams.frames import Frame, SourceError
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.results import ResultsWriter, read_region_records
from conformodal.pipeline.stream import StreamClock, StreamRunner
from tests.small_model import image, small_model

AT_MOST = 10  # frames in a row whose time does not go on


def frame(name, timestamp_s, picture=None):
    return Frame(str(name), timestamp_s, picture)


def checked(times):
    """The problems of frames with these times, in order."""
    clock = StreamClock()
    return [clock.check(frame(k, time)) for k, time in enumerate(times)]


CLOCKS = {  # times, and the frames that they cost
    "repeats": ([0.0, 0.1, 0.1, 0.1, 0.2, 0.2, 0.3], [2, 3, 5]),
    "jumps back a little": ([5.0, 5.1, 4.9, 5.0, 5.1, 5.2, 5.3], [2, 3, 4]),
    "stops for a while": ([0.0, *[0.1] * (1 + AT_MOST), 0.2], list(range(2, 2 + AT_MOST))),
    "is silent for minutes": ([0.0, 0.1, 600.0, 600.1], []),
    "is no number": ([0.0, np.nan, np.inf, -np.inf, 0.1], [1, 2, 3]),
    "stops twice": ([0.0, *[0.0] * AT_MOST, 0.1, *[0.1] * AT_MOST, 0.2], [*range(1, 11), *range(12, 22)]),
}


@pytest.mark.parametrize("what", CLOCKS)
def test_exactly_the_frames_with_invalid_times_are_named(what):
    times, lost = CLOCKS[what]
    problems = checked(times)
    assert [k for k, problem in enumerate(problems) if problem] == lost
    for k in lost:
        assert (f"{k} at {times[k]} s follows" in problems[k]) or "expected a finite number" in problems[k]


SET_BACK = {  # times of frames in order, of those that are lost, and of the one that ends the stream
    "by an hour": ([7200.0], [3600.0 + k for k in range(AT_MOST)], 3700.0),
    "after a stop": ([7200.0], [7200.0] * AT_MOST, 3700.0),
    "after one time far ahead": ([0.0, 1e9], [0.1 * k for k in range(AT_MOST)], 1.0),
}


@pytest.mark.parametrize("what", SET_BACK)
def test_a_clock_that_stays_back_ends_the_stream(what):
    in_order, lost, end = SET_BACK[what]
    clock = StreamClock()
    for time in in_order:
        assert not clock.check(frame(f"at {time}", time))
    last = f"follows at {in_order[-1]} at {in_order[-1]} s"
    for k, time in enumerate(lost):
        assert last in clock.check(frame(k, time))
    with pytest.raises(SourceError, match=re.escape(f"time goes back: next at {end} s {last}")):
        clock.check(frame("next", end))


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture(scope="module")
def pictures():
    return [np.roll(image(), k, axis=1) for k in range(10)]


def test_results_hold_what_has_a_time_and_the_rest_is_counted(model, pictures, tmp_path):
    times = [0.0, 0.1, 0.1, 0.05, np.nan, 0.2, 400.0, 400.1]
    with ResultsWriter(tmp_path) as writer, StreamRunner(VisualOdometry(model), writer) as runner:
        answers = [runner.push(frame(k, time, pictures[k])) for k, time in enumerate(times)]
        runner.finish()
        records = list(writer.records())
    assert [k for k, answer in enumerate(answers) if answer is None] == [2, 3, 4] == list(map(int, runner.problems))
    assert (runner.n_answered, runner.n_problems) == (5, 3)
    assert [one["timestamp_s"] for one in records] == [0.0, 0.1, 0.2, 400.0, 400.1]
    for path in runner.trajectories.values():
        assert path.timestamps_s.tolist() == [0.0, 0.1, 0.2, 400.0, 400.1]


def test_after_a_long_gap_the_path_is_forgotten(model, pictures):
    """The path before says nothing: a frame much later is answered as the first one of a stream is."""
    odometry, fresh = VisualOdometry(model), VisualOdometry(model)
    for k in range(5):
        odometry.step(pictures[k], 0.1 * k)
    late, first = odometry.step(pictures[9], 1800.0), fresh.step(pictures[9], 1800.0)
    assert late.posterior.unseen_s == first.posterior.unseen_s
    assert late.position_spread_m == pytest.approx(first.position_spread_m, rel=0.05)
    with pytest.raises(OdometryError, match=r"increase: 0\.5 s follows 1800\.0 s"):
        odometry.step(pictures[5], 0.5)
    assert odometry.step(pictures[8], 1800.1).pose is not None


class Repeating(VisualOdometry):
    """Answers frames again and again as it has answered the first ten, in no time."""

    def __init__(self, model):
        self.answers = []
        super().__init__(model)

    def _answer(self, picture, timestamp_s):
        if len(self.answers) < 10:
            self.answers.append(super()._answer(picture, timestamp_s))
        answer = self.answers[round(30 * timestamp_s) % len(self.answers)]
        return replace(answer, timestamp_s=timestamp_s)


@pytest.mark.slow
@pytest.mark.parametrize(("odometry", "n_frames"), [(Repeating, 400), (VisualOdometry, 200)])
def test_what_a_stream_holds_does_not_grow(model, pictures, tmp_path, odometry, n_frames):
    """Objects of Python and NumPy; benchmarks/long_stream.py measures the memory of the process."""
    held, step = [], n_frames // 40
    with ResultsWriter(tmp_path) as writer, StreamRunner(odometry(model), writer, window=50, overlap=10) as runner:
        tracemalloc.start()
        try:
            for k in range(n_frames):
                runner.push(frame(k, k / 30, pictures[abs(k % 18 - 9)]))
                if (k + 1) % step == 0:
                    runner._finish_window()  # on a busy machine a thread would still hold what it works on
                    gc.collect()
                    held.append(tracemalloc.get_traced_memory()[0])
        finally:
            tracemalloc.stop()
        runner.finish()
    assert len(read_region_records(tmp_path / "regions.jsonl.part")) == n_frames
    assert all(len(path) == n_frames for path in runner.trajectories.values())
    # what waits for more frames comes and goes: the least of the second quarter and of the last one. Records and poses
    # would take more than 10 kB per frame
    second, last = min(held[10:20]), min(held[30:])
    assert (last - second) / (20 * step) < 1000, held
