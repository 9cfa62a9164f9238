import numpy as np
import pytest

from conformodal.model.errors import ResultsError
from conformodal.poses import Trajectory, TrajectoryFileError, read_tum
from conformodal.running.results.records import read_region_records, records_contain, records_hold
from conformodal.running.results.runs import read_metrics


def record(**parts):
    names = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")
    return {"timestamp_s": 0.0, "intervals": {n: parts.get(n, [[None, None]]) for n in names}}


def test_stored_intervals_hold_what_they_should():
    truth = Trajectory(np.zeros(1), np.array([[1.0, 2.0, 3.0]]), np.array([[-1.0, 0, 0, 0]]))
    reference = np.array([1.0, 0, 0, 0])
    parts = record(x=[[0.0, 0.5], [0.9, 1.0]], y=[[2.1, 3.0]], z=[], q_w=[[0.9, 1.0]])
    assert records_contain([parts], truth, reference).tolist() == [[True, False, False, True, True, True, True]]


def test_a_region_of_places_holds_a_pose_in_one_of_its_boxes():
    truth = Trajectory(
        np.arange(3.0), np.array([[0.5, 0, 0], [5.5, 0, 0], [0.5, 9, 0]]), np.tile([1.0, 0, 0, 0], (3, 1))
    )
    reference = np.array([1.0, 0, 0, 0])
    box, other = [[0.0, 1.0], *[[-1.0, 1.0]] * 6], [[5.0, 6.0], [8.0, 9.0], *[[-1.0, 1.0]] * 5]
    rest = {name: [[-1.0, 1.0]] for name in ("z", "q_w", "q_x", "q_y", "q_z")}
    records = [record(x=[[0.0, 1.0], [5.0, 6.0]], y=[[-1.0, 1.0], [8.0, 9.0]], **rest)] * 3
    places = [{"p": 0.6, "box": box}, {"p": 0.3, "box": other}]
    assert records_hold(records, truth, reference).tolist() == [True, True, True]
    records = [{**one, "places": places} for one in records]
    assert records_hold(records, truth, reference).tolist() == [True, False, False]
    unbounded = [{**record(), "places": [{"p": 1.0, "box": [[None, None]] * 7}]}] * 3
    assert records_hold(unbounded, truth, reference).all()


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
