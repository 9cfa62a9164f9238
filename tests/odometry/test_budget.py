import math
import warnings

import numpy as np
import pytest

from conformodal.odometry import BudgetWarning, FrameBudget, OdometryError

COLD, WINDOW = 3, 200


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def stream(budget_ms, n, unmatched_ms, matched_ms):
    """What a stream of n frames does whose frames take so long; a number, or one a frame."""
    clock = Clock()
    budget = FrameBudget(budget_ms, clock)
    matched, times = [], []
    for k in range(n):
        matched.append(budget.has_room)
        its = matched_ms if matched[-1] else unmatched_ms
        times.append(its if np.isscalar(its) else its[k])
        budget.start()
        clock.now += times[-1] / 1e3
        budget.stop(matched=matched[-1])
    return np.array(matched), np.array(times), budget


def test_where_there_is_time_all_frames_are_matched():
    matched, _, budget = stream(36, 500, 20, 35)
    assert matched.all()
    record = budget.record
    assert (record.n_frames, record.n_over) == (500 - COLD, 0)
    assert record.median_ms == record.p99_ms == pytest.approx(35)
    assert math.isnan(record.unmatched_ms)
    assert record.table()["unmatched_ms"] is None
    assert not record.out_of_reach


def test_where_matching_takes_too_long_one_frame_in_a_hundred_tries_it():
    matched, times, budget = stream(30, 3000, 20, 35)
    tried = np.flatnonzero(matched)
    # those that are not counted, then two in each window, at its beginning
    expected = [*range(COLD)] + [COLD + start + k for start in range(0, 3000 - COLD - 1, WINDOW + 1) for k in (0, 1)]
    assert tried[:5].tolist() == [0, 1, 2, 3, 4]
    assert tried[5:9].tolist() == [204, 205, 405, 406]
    assert tried.tolist() == expected
    over = times[COLD:] > 30
    assert max(np.convolve(over, np.ones(WINDOW), mode="valid")) == 2  # of any two hundred frames
    assert np.percentile(times[COLD : COLD + 14 * (WINDOW + 1)], 99) <= 30
    assert np.median(times) == 20
    record = budget.record
    assert record.n_over == len(tried) - COLD
    assert record.unmatched_ms == pytest.approx(20)


def test_matching_comes_back_when_there_is_time_again():
    slow_then_quick = np.r_[np.full(50, 35.0), np.full(400, 25.0)]
    matched, _, _ = stream(30, 450, 20, slow_then_quick)
    assert matched[:5].all()
    assert not matched[5:204].any()
    assert matched[204:].all()


def test_a_rare_late_frame_does_not_stop_matching():
    late = np.full(1000, 25.0)
    late[10::150] = 60.0
    matched, _, _ = stream(30, 1000, 20, late)
    # frames 10 and 160 are late, and frame 10 leaves the window with frame 210
    assert not matched[161:211].any()
    assert matched[:161].all()
    assert matched[211:310].all()


def test_a_budget_out_of_reach_is_said_once_and_no_frame_is_matched():
    with pytest.warns(BudgetWarning, match=r"takes 20\.0 ms .* budget of 15 ms") as said:
        matched, _, budget = stream(15, 600, 20, 35)
    assert len(said) == 1
    assert matched.sum() == 5
    assert budget.record.out_of_reach
    assert budget.record.table()["out_of_reach"] is True


def test_a_slow_spell_is_no_reason_to_warn():
    spell = np.full(300, 20.0)
    spell[100:115] = 50.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stream(30, 300, spell, 35)


@pytest.mark.parametrize("budget_ms", [0, -1, math.inf, math.nan])
def test_a_budget_is_a_positive_number(budget_ms):
    with pytest.raises(OdometryError, match="budget_ms"):
        FrameBudget(budget_ms)
