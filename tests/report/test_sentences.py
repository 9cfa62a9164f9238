from itertools import product

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
    given["places"] = [(list(box), None) for box in product(*intervals)]
    return PageFrame(
        "f", 0.0, position_xyz=np.array(position), quat_wxyz=np.eye(4)[0], intervals=intervals, **given, **known
    )


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (
            frame([HERE] * 3, truth=(0.01, 0, 0)),
            "The region names one place, 10 by 10 by 10 cm. The chosen pose is 4.2 cm and 0.90 degrees from the truth; "
            "the true position lies in the region.",
        ),
        (
            frame([THERE, HERE, HERE], truth=(5, 0, 0), error=5),
            "The region names 2 places, the largest 25 by 10 by 10 cm. The path chooses one of them, 5.00 m and 0.90 "
            "degrees from the truth; the true position lies outside the region.",
        ),
        (
            frame([THERE, THERE, HERE], position=(5, 0, 0), truth=(10, 10, 0), error=5),
            "The region names 4 places, the largest 25 by 25 by 10 cm. The chosen pose lies in none of them, 5.00 m "
            "and 0.90 degrees from the truth; the true position lies in the region.",
        ),
        (frame([HERE] * 3), "The region names one place, 10 by 10 by 10 cm. The chosen pose lies in it."),
        (
            frame([THERE, HERE, HERE], position=(5, 0, 0)),
            "The region names 2 places, the largest 25 by 10 by 10 cm. The chosen pose lies in none of them.",
        ),
        (
            frame([THERE, LINE, HERE]),
            "The region names 2 places, without bounds along y. The chosen pose lies in one of them.",
        ),
        (frame([LINE] * 3), "The region is unbounded: every position is possible."),
        (
            frame([LINE] * 3, evidence="unknown", known_p=0.00312, reliable=False, truth=(0, 0, 0)),
            "Unknown place (p = 0.0031): the image shows no known place, so the region is unbounded. The "
            "chosen pose is 4.2 cm and 0.90 degrees from the truth.",
        ),
        (frame([[], HERE, HERE]), "The region is empty: no place is likely enough."),
        (
            frame([HERE] * 3, reliable=False, motion="too_few_corners"),
            "The region names one place, 10 by 10 by 10 cm. The chosen pose lies in it. The motion since the frame "
            "before is not reliable (too few corners).",
        ),
    ],
)
def test_the_sentence_of_a_frame(shown, expected):
    assert describe_frame(shown) == expected


def test_unbounded_regions_do_not_count_as_holding_the_truth():
    found = RunStatistics()
    for one in (frame([LINE] * 3, truth=(0, 0, 0)), frame([HERE, LINE, HERE], truth=(0, 0, 0))):
        found.add(one)
    assert (found.n_bounded, found.n_held) == (0, 0)
    assert "the true position" not in describe_run(found)


def test_the_error_that_a_robot_gets_comes_before_the_one_with_hindsight():
    found = RunStatistics()
    for _ in range(2):
        found.add(frame([HERE] * 3, truth=(0, 0, 0), error=0.18))
    said = describe_run(found, 0.69)
    assert 0 < said.index("69 cm") < said.index("18 cm")


def statistics_of(*frames):
    found = RunStatistics()
    for one in frames:
        found.add(one)
    return describe_run(found)


def test_the_sentence_of_a_run():
    one, two = frame([HERE] * 3, truth=(0, 0, 0), error=3.0), frame([THERE, HERE, HERE], truth=(5, 0, 0), error=4.0)
    unknown = frame([LINE] * 3, evidence="unknown", truth=(0, 0, 0), error=0.0)
    assert statistics_of(one) == (
        "One frame was answered: its region names 1 place. It holds the true position. The chosen pose is 3.00 m from "
        "the truth."
    )
    assert "names 2 places. It does not hold the true position" in statistics_of(two)
    assert statistics_of(one, two, two, unknown) == (
        "Of 4 frames, the region names one place in 1, names several in 2 (at most 2) and is unbounded in 1 (it "
        "shows no known place). Of 3 bounded regions, 1 holds the true position. The chosen path is "
        "3.20 m from the truth (RMSE)."
    )  # sqrt((9 + 16 + 16) / 4)
    assert "is unbounded in 2 (1 of them shows no known place)" in statistics_of(unknown, frame([LINE] * 3))
    assert "is unbounded in 2 (they show no known place)" in statistics_of(unknown, unknown)
    assert "is unbounded (it shows no known place). The chosen pose" in statistics_of(unknown)
    assert "names one place in 1 and is empty in 1." in statistics_of(one, frame([[], HERE, HERE]))
    assert statistics_of(frame([LINE] * 3)) == "One frame was answered: its region is unbounded."
    assert statistics_of(frame([[], HERE, HERE])) == "One frame was answered: its region is empty."
    assert statistics_of() == "No frame was answered."


@pytest.mark.parametrize(
    ("metres", "expected"),
    [(0.0, "0 mm"), (0.00042, "0.42 mm"), (0.0034, "3.4 mm"), (0.01, "1.0 cm"), (0.4567, "46 cm"), (1, "1.00 m"),
     (12.345, "12.3 m"), (1234.5, "1234 m")],
)  # fmt: skip
def test_lengths_have_the_unit_that_suits_them_and_no_powers_of_ten(metres, expected):
    assert describe_length(metres) == expected


def test_sizes_have_one_unit():
    assert describe_size([0.034, 0.5, 0.0004]) == "3.4 by 50 by 0.040 cm"
    assert describe_size([250.0, 1.0, 0.0]) == "250 by 1.0 by 0 m"


def test_counts_agree_with_their_nouns():
    assert [counted(n, "frame") for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [counted(n, "stretch", "stretches") for n in (1, 3)] == ["1 stretch", "3 stretches"]
    assert [noun_for(n, "is", "are") for n in (1, 2)] == ["is", "are"]
    assert counted(np.int64(1), "frame") == "1 frame"


def test_a_place_that_is_one_of_several_is_told_with_its_probability():
    assert "had a probability of 0.460" in describe_frame(frame([HERE] * 3, reliable=False, place_p=0.46))
    assert "probability" not in describe_frame(frame([HERE] * 3, place_p=0.98))
