import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from conformodal.core.errors import ConformodalError
from conformodal.pipeline.workers import Engine
from experiments.tasks import ExperimentError, run_tasks

os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")  # as run_tasks sets it; read when ray is imported
ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Square:
    number: int
    version: int = 1

    @property
    def key(self):
        return f"square-{self.number}"

    @property
    def settings(self):
        return {"number": self.number, "version": self.version, "shape": (1, 2)}


class Counting:
    """Squares numbers, remembers which, and may be interrupted."""

    def __init__(self, stop_at=None):
        self.done, self.stop_at = [], stop_at

    def __call__(self, task):
        if task.number == self.stop_at:
            raise KeyboardInterrupt
        self.done.append(task.number)
        return {"square": task.number**2}


@dataclass(frozen=True)
class Meeting:
    """Squares numbers in processes that wait for each other, so that two must work at the same time."""

    folder: Path
    seconds: float = 60.0

    def __call__(self, task):
        if task.number < 0:
            raise ExperimentError("numbers must not be negative")
        (self.folder / f"{os.getpid()}").touch()
        end = time.monotonic() + self.seconds
        while len(list(self.folder.iterdir())) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        return {"square": task.number**2, "process": os.getpid(), "threads": most_threads()}


class Killed:
    def __call__(self, task):
        os.kill(os.getpid(), 9)


def most_threads():
    """Of whichever library has the most."""
    import cv2
    from threadpoolctl import threadpool_info

    return max(cv2.getNumThreads(), *(pool["num_threads"] for pool in threadpool_info()))


def test_results_come_in_order_and_are_kept(tmp_path):
    tasks = [Square(k) for k in (3, 1, 2)]
    work, seen = Counting(), []
    results = run_tasks(tasks, work, tmp_path / "new", lambda *a: seen.append(a))
    assert [r["square"] for r in results] == [9, 1, 4]
    assert seen == [("tasks", k, 3) for k in range(4)]
    again = Counting()
    assert run_tasks(tasks, again, tmp_path / "new") == results
    assert again.done == []


def test_a_stopped_run_goes_on_where_it_was(tmp_path):
    tasks = [Square(k) for k in range(5)]
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, Counting(stop_at=3), tmp_path)
    rest = Counting()
    assert [r["square"] for r in run_tasks(tasks, rest, tmp_path)] == [0, 1, 4, 9, 16]
    assert rest.done == [3, 4]


def test_damaged_or_outdated_results_are_recomputed(tmp_path):
    run_tasks([Square(k) for k in range(4)], Counting(), tmp_path)
    (tmp_path / "square-1.json").write_text("{")
    (tmp_path / "square-2.json").write_text("[]")
    record = json.loads((tmp_path / "square-3.json").read_text())
    (tmp_path / "square-3.json").write_text(json.dumps({**record, "result": 5}))
    work = Counting()
    run_tasks([Square(0), Square(1), Square(2), Square(3)], work, tmp_path)
    assert work.done == [1, 2, 3]
    work = Counting()
    run_tasks([Square(0, version=2)], work, tmp_path)
    assert work.done == [0]


def check_two_at_a_time(folder, **where):
    (folder / "met").mkdir()
    tasks = [Square(k) for k in range(5)]
    results = run_tasks(tasks, Meeting(folder / "met"), folder / "stored", **where)
    assert [r["square"] for r in results] == [0, 1, 4, 9, 16]
    assert len({r["process"] for r in results}) == 2
    assert os.getpid() not in {r["process"] for r in results}
    assert len(list((folder / "stored").iterdir())) == 5
    return results


def check_errors_keep_what_was_done(folder, **where):
    run_tasks([Square(1)], Counting(), folder / "stored")
    with pytest.raises(ExperimentError, match="must not be negative"):
        run_tasks([Square(1), Square(-1), Square(-2)], Meeting(folder, 0), folder / "stored", **where)
    assert [p.name for p in (folder / "stored").iterdir()] == ["square-1.json"]


def test_processes_share_the_cores_and_the_work(tmp_path):
    results = check_two_at_a_time(tmp_path, workers=2)
    assert {r["threads"] for r in results} == {max(1, os.cpu_count() // 2)}


def test_an_error_in_a_process_is_raised_here(tmp_path):
    check_errors_keep_what_was_done(tmp_path, workers=2)


def test_a_killed_process_is_named_and_finished_results_stay(tmp_path):
    run_tasks([Square(1)], Counting(), tmp_path)
    with pytest.raises(ExperimentError, match="a worker process was killed"):
        run_tasks([Square(k) for k in (1, 2, 3)], Killed(), tmp_path, workers=2)
    assert [p.name for p in tmp_path.iterdir()] == ["square-1.json"]


@pytest.mark.slow
def test_ray_cluster_shares_the_work_and_raises_errors(tmp_path):
    ray = pytest.importorskip("ray")
    utils = pytest.importorskip("ray.cluster_utils")
    with pytest.MonkeyPatch.context() as patch:
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(paths))  # what the nodes' workers start with
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        cluster = utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1)
            where = {"engine": Engine.RAY, "address": cluster.address}
            results = check_two_at_a_time(tmp_path, **where)
            assert {r["threads"] for r in results} == {1}
            (tmp_path / "other").mkdir()
            check_errors_keep_what_was_done(tmp_path / "other", **where)
        finally:
            ray.shutdown()
            cluster.shutdown()


def test_a_cluster_that_is_not_there_is_named(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")

    def refuse(*_, **__):  # Ray itself tries for minutes
        raise ConnectionError("nobody answers")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ConformodalError, match=r"no Ray cluster at '127\.0\.0\.1:1': nobody answers"):
        run_tasks([Square(1)], Counting(), tmp_path, engine=Engine.RAY, address="127.0.0.1:1")


def test_ray_that_is_not_installed_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConformodalError, match=r"pip install 'conformodal\[ray\]'"):
        run_tasks([Square(1)], Counting(), tmp_path, engine=Engine.RAY)
