"""Sentences say what is in a frame and in a run: counts, places, lengths in a unit that suits them."""

import numpy as np
import pytest

from conformodal.core.words import counted, noun_for
from conformodal.report.page_frames import PageFrame
from conformodal.report.sentences import RunStatistics, describe_frame, describe_length, describe_run, describe_size

HERE = [[-0.05, 0.05]]
THERE = [[-0.05, 0.05], [9.9, 10.15]]
LINE = [[None, None]]


def frame(intervals, position=(0.0, 0.0, 0.0), truth=None, error=0.042, **other):
    known = {} if truth is None else {"truth_xyz": np.array(truth), "error_m": error, "error_deg": 0.9}
    given = {"reliable": True, "motion": "ok", "known_p": 0.4, "evidence": "landmarks"} | other
    return PageFrame(
        "f", 0.0, position_xyz=np.array(position), quat_wxyz=np.eye(4)[0], intervals=intervals, **given, **known
    )


INSIDE, OUTSIDE = "lies in the region", "lies outside the region"
FRAMES = [
    (frame([HERE] * 3, truth=(0.01, 0, 0)), ["one place", "10 by 10 by 10 cm", "4.2 cm", INSIDE]),
    (frame([THERE, HERE, HERE], truth=(5, 0, 0), error=5), ["2 places", "25 by 10 by 10 cm", "5.00 m", OUTSIDE]),
    (frame([THERE, THERE, HERE], (5, 0, 0), (10, 10, 0), 5), ["4 places", "in none of them", INSIDE]),
    (frame([HERE] * 3), ["one place", "pose lies in it"]),
    (frame([THERE, HERE, HERE], position=(5, 0, 0)), ["2 places", "in none of them"]),
    (frame([THERE, LINE, HERE]), ["2 places", "without bounds along y", "in one of them"]),
    (frame([LINE] * 3), ["unbounded"]),
    (frame([LINE] * 3, evidence="unknown", known_p=0.00312, truth=(0, 0, 0)), ["p = 0.0031", "unbounded", "4.2 cm"]),
    (frame([[], HERE, HERE]), ["empty"]),
    (frame([HERE] * 3, reliable=False, motion="too_few_corners"), ["one place", "not reliable (too few corners)"]),
    (frame([HERE] * 3, reliable=False, place_p=0.46), ["probability of 0.460"]),
]


@pytest.mark.parametrize(("shown", "facts"), FRAMES)
def test_the_sentence_of_a_frame(shown, facts):
    said = describe_frame(shown)
    assert [fact for fact in facts if fact not in said] == []
    assert (INSIDE in said, OUTSIDE in said) == (INSIDE in facts, OUTSIDE in facts)
    assert ("probability" in said) == (shown.place_p is not None)


def run_of(*frames, online=None):
    found = RunStatistics()
    for one in frames:
        found.add(one)
    return describe_run(found, online)


ONE = frame([HERE] * 3, truth=(0, 0, 0), error=3.0)
TWO = frame([THERE, HERE, HERE], truth=(5, 0, 0), error=4.0)
UNKNOWN = frame([LINE] * 3, evidence="unknown", truth=(0, 0, 0), error=0.0)
EMPTY = frame([[], HERE, HERE])
RUNS = [
    ([], ["No frame"]),
    ([ONE], ["1 place", "It holds", "3.00 m"]),
    ([TWO], ["2 places", "does not hold"]),
    ([EMPTY], ["is empty"]),
    ([UNKNOWN], ["is unbounded (it shows no known place)"]),
    ([UNKNOWN, UNKNOWN], ["unbounded in 2 (they show no known place)"]),
    ([UNKNOWN, frame([LINE] * 3)], ["unbounded in 2 (1 of them shows no known place)"]),
    ([ONE, EMPTY], ["one place in 1 and is empty in 1"]),
    # sqrt((9 + 16 + 16) / 4)
    ([ONE, TWO, TWO, UNKNOWN], ["Of 4 frames", "several in 2 (at most 2)", "Of 3 bounded regions, 1 holds", "3.20 m"]),
]


@pytest.mark.parametrize(("frames", "facts"), RUNS)
def test_the_sentence_of_a_run(frames, facts):
    said = run_of(*frames)
    assert [fact for fact in facts if fact not in said] == []


def test_unbounded_regions_do_not_count_as_holding_the_truth():
    said = run_of(frame([LINE] * 3, truth=(0, 0, 0)), frame([HERE, LINE, HERE], truth=(0, 0, 0)))
    assert "the true position" not in said


def test_the_error_that_a_robot_gets_comes_before_the_one_with_hindsight():
    said = run_of(*[frame([HERE] * 3, truth=(0, 0, 0), error=0.18)] * 2, online=0.69)
    assert 0 < said.index("69 cm") < said.index("18 cm")


@pytest.mark.parametrize(
    ("metres", "expected"),
    [(0.0, "0 mm"), (0.00042, "0.42 mm"), (0.0034, "3.4 mm"), (0.01, "1.0 cm"), (0.4567, "46 cm"), (1, "1.00 m"),
     (12.345, "12.3 m"), (1234.5, "1234 m")],
)  # fmt: skip
def test_lengths_have_the_unit_that_suits_them(metres, expected):
    assert describe_length(metres) == expected


def test_sizes_have_one_unit_and_counts_agree_with_their_nouns():
    assert describe_size([0.034, 0.5, 0.0004]) == "3.4 by 50 by 0.040 cm"
    assert [counted(n, "stretch", "stretches") for n in (0, 1, 3)] == ["0 stretches", "1 stretch", "3 stretches"]
    assert [noun_for(n, "is", "are") for n in (1, 2)] == ["is", "are"]
