import numpy as np
import pytest

from conformodal.geometry import Trajectory
from conformodal.localizer.regions import EvidenceType
from conformodal.report.viewer import kind_of, make_viewer
from tests.helpers import region_record

HERE = np.array([[-0.05, 0.05]])
THERE = np.array([[-0.05, 0.05], [9.9, 10.15]])
LINE = np.array([[-np.inf, np.inf]])
NONE = np.empty((0, 2))


@pytest.mark.parametrize(
    ("parts", "position", "truth", "kind", "facts"),
    [
        ([HERE] * 3, (0, 0, 0), (0.042, 0, 0), "one place",
         ("1 place of 0.100 x 0.100 x 0.100", "0.042 m and 0.00 degrees from the true one, which the region contains")),
        ([THERE, HERE, HERE], (0, 0, 0), (5, 0, 0), "several places", ("2 places", "5.000 m", "the region misses")),
        ([THERE, THERE, HERE], (5, 0, 0), None, "several places", ("4 places", "lies outside it")),
        ([THERE, LINE, HERE], (0, 0, 0), None, "several places", ("2 places", "x inf x")),
        ([LINE] * 3, (0, 0, 0), (1, 0, 0), "unbounded", ("is unbounded", "1.000 m")),
        ([LINE] * 3, (0, 0, 0), None, "unknown place", ("p = 0.0031", "is unbounded")),
        ([NONE, HERE, HERE], (0, 0, 0), None, "empty", ("is empty",)),
    ],
)  # fmt: skip
def test_a_sentence_describes_region_and_pose(parts, position, truth, kind, facts):
    evidence = EvidenceType.UNKNOWN if kind == "unknown place" else EvidenceType.LANDMARKS
    record = region_record("f", 0.0, [*parts, *[LINE] * 4], 0.00312, evidence)
    here, there = (None if at is None else Trajectory([0.0], [at], [[1.0, 0, 0, 0]]) for at in (position, truth))
    (shown,) = make_viewer([record], {"smoothed": here}, there)["data"]["frames"]
    assert kind_of(shown) == kind
    for fact in facts:
        assert fact in shown["say"]
