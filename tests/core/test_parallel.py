import time
from contextlib import suppress

import pytest
from threadpoolctl import threadpool_info

from conformodal.core import parallel as process
from conformodal.core.parallel import in_threads, side_by_side


@pytest.fixture
def threads(monkeypatch):
    return lambda n: monkeypatch.setattr(process, "_limit", n)


@pytest.mark.parametrize("n", [1, 3])
def test_results_are_in_the_order_of_the_items_and_products_take_one_thread(threads, n):
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


def test_an_interrupt_ends_what_other_threads_do(threads):
    threads(2)
    done = []

    def work(item):
        time.sleep(0.002)
        done.append(item)

    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_threads(lambda n: in_threads(work, range(n)), [0, 2000], interrupt)
    assert len(done) < 1000
    assert in_threads(str, range(3)) == ["0", "1", "2"]


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
        side_by_side(*jobs)
    assert len(done) < 1000
    assert in_threads(str, range(3)) == ["0", "1", "2"]


def test_an_error_that_is_caught_ends_nothing_around_it(threads):
    threads(2)

    def caught(item):
        with suppress(ZeroDivisionError):
            in_threads(lambda n: 1 / n, [item, 0])
        time.sleep(0.01)
        return in_threads(str, [item])

    assert in_threads(caught, [1, 2, 3]) == [["1"], ["2"], ["3"]]
