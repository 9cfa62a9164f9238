import os
import signal
import time
from math import sqrt

import joblib
import pytest
from threadpoolctl import threadpool_info

from conformodal.core.errors import ConformodalError
from conformodal.core.parallel import in_threads, in_workers
from conformodal.pipeline.workers import Engine, parallel_workers


@pytest.fixture
def threads(monkeypatch):
    return lambda n: monkeypatch.setenv("OMP_NUM_THREADS", str(n))


@pytest.mark.parametrize("n", [1, 3])
def test_threads_keep_the_order_and_use_one_blas_thread(threads, n):
    threads(n)
    told = []

    def work(item):
        return item, {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    before = threadpool_info()
    assert in_threads(work, range(20), lambda *now: told.append(now)) == [(i, {1}) for i in range(20)]
    assert told == [(i, 20) for i in range(1, 21)]
    assert threadpool_info() == before
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda item: 1 / item, range(3))
    assert threadpool_info() == before


@pytest.mark.parametrize("failing", [0, 1])
def test_an_error_ends_what_other_threads_do(threads, failing):
    threads(2)
    done = []

    def work(item):
        time.sleep(0.002)
        done.append(item)

    def fail():
        time.sleep(0.02)
        in_threads(lambda item: 1 / item, [1, 0])

    jobs = [lambda: in_threads(work, range(2000))] * 2
    jobs[failing] = fail
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda job: job(), jobs)
    assert len(done) < 1000
    assert in_threads(str, range(3)) == ["0", "1", "2"]


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_are_those_of_joblib_and_give_the_same(workers):
    with joblib.parallel_config(n_jobs=workers):
        assert in_workers(sqrt, range(5)) == [sqrt(i) for i in range(5)]
        assert (os.getpid() in in_workers(lambda _: os.getpid(), range(3))) == (workers == 1)
        assert in_workers(lambda _: os.getpid(), [0]) == [os.getpid()]  # one alone has all threads here
        with pytest.raises(ValueError, match=r"math domain|expected a nonnegative"):
            in_workers(sqrt, [1, -1])


def killed_once(mark):
    def work(item):
        if item == 2 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return item, os.getpid()

    return work


def test_a_process_that_is_killed_is_named(tmp_path):
    with joblib.parallel_config(n_jobs=2), pytest.raises(ConformodalError, match="a worker process was killed"):
        in_workers(killed_once(tmp_path / "killed"), range(6))


@pytest.mark.slow
def test_ray_does_again_what_a_killed_worker_was_at(tmp_path):
    pytest.importorskip("ray")
    with parallel_workers(2, Engine.RAY, "local"):
        items, processes = zip(*in_workers(killed_once(mark := tmp_path / "killed"), range(6)), strict=True)
    assert (mark.exists(), *items) == (True, *range(6))
    assert os.getpid() not in processes
