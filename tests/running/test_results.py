import numpy as np
import pytest

from conformodal.model.errors import ResultsError
from conformodal.poses import Trajectory, TrajectoryFileError, read_tum
from conformodal.running.results.records import read_region_records, records_contain
from conformodal.running.results.runs import read_metrics


def record(**parts):
    names = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")
    return {"timestamp_s": 0.0, "intervals": {n: parts.get(n, [[None, None]]) for n in names}}


def test_stored_intervals_hold_what_they_should():
    truth = Trajectory(np.zeros(1), np.array([[1.0, 2.0, 3.0]]), np.array([[-1.0, 0, 0, 0]]))
    reference = np.array([1.0, 0, 0, 0])
    parts = record(x=[[0.0, 0.5], [0.9, 1.0]], y=[[2.1, 3.0]], z=[], q_w=[[0.9, 1.0]])
    assert records_contain([parts], truth, reference).tolist() == [[True, False, False, True, True, True, True]]


@pytest.mark.parametrize("line", ["", "{}", '{"intervals": {}, "timestamp_s": 1}', "nonsense"])
def test_damaged_records_are_named(tmp_path, line):
    path = tmp_path / "regions.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(ResultsError, match=r"regions\.jsonl, line 1"):
        read_region_records(path)


def test_missing_results_are_named(tmp_path):
    with pytest.raises(ResultsError, match=r"regions\.jsonl"):
        read_region_records(tmp_path / "regions.jsonl")
    (tmp_path / "metrics.json").write_text("[]")
    with pytest.raises(ResultsError, match="expected an object"):
        read_metrics(tmp_path)
    with pytest.raises(TrajectoryFileError, match=r"trajectory\.tum"):
        read_tum(tmp_path / "trajectory.tum")
