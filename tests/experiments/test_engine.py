import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conformodal.experiments import ExperimentError, LocalEngine, RayEngine, run_tasks

sys.path.insert(0, str(Path(__file__).parent))
from squares import Counting, InStep, Meeting, Square


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


def test_results_of_other_settings_or_damaged_ones_are_worked_out_again(tmp_path):
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


def test_tasks_that_share_a_key_are_refused(tmp_path):
    with pytest.raises(ExperimentError, match="square-1"):
        run_tasks([Square(1), Square(1, version=2)], Counting(), tmp_path)


@pytest.fixture
def importable(monkeypatch):
    """Processes of an engine find the tasks' module."""
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])]))


def check_two_at_a_time(engine, folder):
    (folder / "met").mkdir()
    tasks = [Square(k) for k in range(5)]
    results = run_tasks(tasks, Meeting(folder / "met"), folder / "kept", engine=engine)
    assert [r["square"] for r in results] == [0, 1, 4, 9, 16]
    assert len({r["process"] for r in results}) == 2
    assert os.getpid() not in {r["process"] for r in results}
    assert len(list((folder / "kept").iterdir())) == 5
    return results


def check_errors_keep_what_was_done(engine, folder):
    run_tasks([Square(1)], Counting(), folder / "kept")
    with pytest.raises(ExperimentError, match="must not be negative"):
        run_tasks([Square(1), Square(-1), Square(-2)], Meeting(folder, 0), folder / "kept", engine=engine)
    assert [p.name for p in (folder / "kept").iterdir()] == ["square-1.json"]


def test_processes_share_the_cores_and_the_work(tmp_path, importable):
    results = check_two_at_a_time(LocalEngine(workers=2), tmp_path)
    assert {r["threads"] for r in results} == {max(1, os.cpu_count() // 2)}


def test_a_worker_goes_on_with_the_group_that_it_has_begun(tmp_path, importable):
    (tmp_path / "met").mkdir()
    tasks = [Square(k, group=group) for k, group in enumerate("aabbab")]
    results = run_tasks(tasks, InStep(tmp_path / "met"), tmp_path / "kept", engine=LocalEngine(workers=2))
    begun = {"a": results[0]["process"], "b": results[2]["process"]}
    assert begun["a"] != begun["b"]
    assert [r["process"] for r in results] == [begun[task.group] for task in tasks]


def test_an_error_in_a_process_is_raised_here(tmp_path, importable):
    check_errors_keep_what_was_done(LocalEngine(workers=2), tmp_path)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_workers_end_when_the_process_that_started_them_is_killed(tmp_path, importable):
    script = (
        "import sys; from pathlib import Path; from squares import Lasting, Square\n"
        "from conformodal.experiments import LocalEngine, run_tasks\n"
        "if __name__ == '__main__':\n"
        "    met, kept = map(Path, sys.argv[1:])\n"
        "    run_tasks([Square(0), Square(1)], Lasting(met), kept, engine=LocalEngine(workers=2))\n"
    )
    (tmp_path / "main.py").write_text(script)
    (tmp_path / "met").mkdir()
    command = [sys.executable, str(tmp_path / "main.py"), str(tmp_path / "met"), str(tmp_path / "kept")]
    main = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    workers = wait_for(lambda: [int(p.name) for p in (tmp_path / "met").iterdir()])
    assert all(Path(f"/proc/{worker}").is_dir() for worker in workers)
    main.kill()
    main.wait()
    assert wait_for(lambda: not any(_alive(worker) for worker in workers))


def _alive(process):
    """Whether a process runs; one that nobody has asked after its end does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(found, seconds=60):
    end = time.monotonic() + seconds
    while not (value := found()) and time.monotonic() < end:
        time.sleep(0.05)
    return value


def test_there_is_at_least_one_worker():
    with pytest.raises(ExperimentError, match="at least 1, got 0"):
        LocalEngine(workers=0)


@pytest.fixture(scope="module")
def two_machines():
    """A Ray cluster of a head without CPUs and two workers with one each."""
    ray = pytest.importorskip("ray")
    utils = pytest.importorskip("ray.cluster_utils")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        cluster = utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        yield cluster.address
        ray.shutdown()
        cluster.shutdown()


@pytest.mark.slow
def test_a_ray_cluster_of_two_workers_shares_the_work_and_raises_errors_here(tmp_path, two_machines):
    results = check_two_at_a_time(RayEngine(two_machines), tmp_path)
    assert {r["threads"] for r in results} == {1}
    (tmp_path / "other").mkdir()
    check_errors_keep_what_was_done(RayEngine(two_machines), tmp_path / "other")


def test_a_cluster_that_is_not_there_is_named(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")

    def refuse(**_):  # Ray itself tries for minutes
        raise ConnectionError("nobody answers")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ExperimentError, match=r"no Ray cluster at '127\.0\.0\.1:1': nobody answers"):
        run_tasks([Square(1)], Counting(), tmp_path, engine=RayEngine("127.0.0.1:1"))


def test_ray_that_is_not_installed_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExperimentError, match=r"pip install 'conformodal\[ray\]'"):
        run_tasks([Square(1)], Counting(), tmp_path, engine=RayEngine())
