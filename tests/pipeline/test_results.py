import shutil
import subprocess

import numpy as np
import pytest

from conformodal.conformal import ConformodalError
from conformodal.geometry import Trajectory
from conformodal.io.pose_files import read_tum
from conformodal.pipeline.provenance import source_revision
from conformodal.pipeline.results import ResultsError, intervals_hold, read_metrics, read_region_records, records_hold


def record(**parts):
    names = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")
    return {"timestamp_s": 0.0, "intervals": {n: parts.get(n, [[None, None]]) for n in names}, "places": None}


def test_stored_intervals_hold_what_they_should():
    truth = Trajectory(np.zeros(1), np.array([[1.0, 2.0, 3.0]]), np.array([[-1.0, 0, 0, 0]]))
    parts = record(x=[[0.0, 0.5], [0.9, 1.0]], y=[[2.1, 3.0]], z=[], q_w=[[0.9, 1.0]])
    held = intervals_hold([parts], truth, np.eye(4)[0])
    assert held.tolist() == [[True, False, False, True, True, True, True]]


def test_a_region_of_places_holds_a_pose_in_one_of_its_boxes():
    places = np.array([[0.5, 0, 0], [5.5, 0, 0], [0.5, 9, 0]])
    truth = Trajectory(np.arange(3.0), places, np.tile([1.0, 0, 0, 0], (3, 1)))
    box, other = [[0.0, 1.0], *[[-1.0, 1.0]] * 6], [[5.0, 6.0], [8.0, 9.0], *[[-1.0, 1.0]] * 5]
    rest = {name: [[-1.0, 1.0]] for name in ("z", "q_w", "q_x", "q_y", "q_z")}
    product = record(x=[[0.0, 1.0], [5.0, 6.0]], y=[[-1.0, 1.0], [8.0, 9.0]], **rest)
    two = {**product, "places": [{"p": 0.6, "box": box}, {"p": 0.3, "box": other}]}
    whole = {**record(), "places": [{"p": 1.0, "box": [[None, None]] * 7}]}
    for one, expected in ((product, [True, True, True]), (two, [True, False, False]), (whole, [True, True, True])):
        for sign in (np.eye(4)[0], None):
            assert records_hold([one] * 3, truth, sign).tolist() == expected


def test_missing_results_are_named(tmp_path):
    for read, name in ((read_region_records, "regions.jsonl"), (read_tum, "trajectory.tum")):
        with pytest.raises(ConformodalError, match=name):
            read(tmp_path / name)
    (tmp_path / "metrics.json").write_text("[]")
    with pytest.raises(ResultsError, match=r"metrics\.json"):
        read_metrics(tmp_path)


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_only_a_changed_source_marks_the_revision_dirty(tmp_path):
    def git(*arguments):
        name = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        return subprocess.run(
            ["git", *name, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout

    assert source_revision(tmp_path) is None
    source, result = tmp_path / "source.py", tmp_path / "benchmarks" / "results" / "table.md"
    result.parent.mkdir(parents=True)
    source.write_text("1")
    result.write_text("1")
    git("init", "-q")
    assert source_revision(tmp_path) is None  # nothing committed yet
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "HEAD")[:12]
    assert source_revision(tmp_path) == commit
    result.write_text("2")
    assert source_revision(tmp_path) == commit
    source.write_text("2")
    assert source_revision(tmp_path) == f"{commit}-dirty"
