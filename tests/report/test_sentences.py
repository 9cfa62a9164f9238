import pytest

from conformodal.geometry import Trajectory
from conformodal.report.page_frames import kind_of, page_frame

HERE = [[-0.05, 0.05]]
THERE = [[-0.05, 0.05], [9.9, 10.15]]
LINE = [[None, None]]


def frame(intervals, position=(0.0, 0.0, 0.0), truth=None, **other):
    def path(place):
        return None if place is None else Trajectory([0.0], [place], [[1.0, 0, 0, 0]])

    record = {"frame": "f", "timestamp_s": 0.0, "reliable": True, "motion": "ok", "known_p": 0.4, "places": None}
    record |= {"path_places": None, "place_p": None, "evidence": "landmarks"}
    record |= {"intervals": dict(zip("xyz", intervals, strict=True))} | other
    inside = truth is not None and max(truth) < 0.05
    return page_frame(record, path(position), path(truth), holds_pose=max(position) < 0.05, holds_truth=inside)


@pytest.mark.parametrize(
    ("shown", "kind", "facts"),
    [
        (
            frame([HERE] * 3, truth=(0.042, 0, 0)),
            "one place",
            (
                "1 place, 0.100 x 0.100 x 0.100 m",
                "0.042 m and 0.00 degrees from the true one, which the region contains",
            ),
        ),
        (frame([THERE, HERE, HERE], truth=(5, 0, 0)), "several places", ("2 places", "5.000 m", "the region misses")),
        (frame([THERE, THERE, HERE], position=(5, 0, 0)), "several places", ("4 places", "lies outside it")),
        (frame([THERE, LINE, HERE]), "several places", ("2 places", "x inf x")),
        (frame([LINE] * 3, truth=(1, 0, 0)), "unbounded", ("is unbounded", "1.000 m")),
        (frame([LINE] * 3, evidence="unknown", known_p=0.00312), "unknown place", ("p = 0.0031", "is unbounded")),
        (frame([[], HERE, HERE]), "empty", ("is empty",)),
    ],
)
def test_a_frame_is_told_by_its_region_and_its_pose(shown, kind, facts):
    assert kind_of(shown) == kind
    for fact in facts:
        assert fact in shown["say"]
