"""Independent tasks in processes or on a Ray cluster, by joblib; results are stored, and a stopped run goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import cv2
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError
from threadpoolctl import threadpool_limits

from conformodal.conformal import ConformodalError
from conformodal.core.files import write_whole
from conformodal.pipeline.workers import Engine, parallel_workers

Result: TypeAlias = dict[str, Any]


class ExperimentError(ConformodalError):
    """An experiment whose parts do not fit together."""


class Task(Protocol):
    """Something to be done once."""

    @property
    def key(self) -> str:
        """A file name without its ending, unique among the tasks."""
        ...

    @property
    def settings(self) -> Result:
        """All that decides the result; JSON."""
        ...


def run_tasks(
    tasks: Sequence[Task],
    work: Callable[[Any], Result],
    folder: Path,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    workers: int | None = None,
    engine: Engine = Engine.LOCAL,
    address: str | None = None,
) -> list[Result]:
    """Results of all tasks, in their order; those on disk with the same settings are not computed again.

    Parameters
    ----------
    tasks
        With different keys.
    work
        Turns a task into a result that JSON can hold. It is pickled for other processes.
    folder
        Each result is written here as soon as it is known. On a cluster it is at the same path on every machine, as are
        the data set and the cache.
    progress
        Called with ``"tasks"``, tasks done and tasks in all; on a cluster only before and after.
    workers
        Tasks at a time. One runs in this process with all cores; several share the cores. None is one on this machine,
        and every CPU of a cluster.
    engine, address
        Where; and the address of a running Ray cluster, by default one that Ray finds or starts.

    Raises
    ------
    ExperimentError
        If two tasks share a key, or a worker is killed. Ray that cannot be used is a ConformodalError.
    """
    keys = [task.key for task in tasks]
    twice = sorted({k for k in keys if keys.count(k) > 1})
    if twice:
        raise ExperimentError(f"tasks need different keys, found twice: {twice}")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{key}.json" for key in keys]
    results = [_stored(path, task.settings) for path, task in zip(paths, tasks, strict=True)]
    missing = [i for i, result in enumerate(results) if result is None]

    def report() -> None:
        if progress is not None:
            progress("tasks", sum(result is not None for result in results), len(tasks))

    report()
    n_jobs = min(workers or 1, max(len(missing), 1))
    threads = None if n_jobs == 1 else max(1, (os.cpu_count() or 1) // n_jobs)
    yields = "generator_unordered"
    if engine is Engine.RAY:  # the CPU that a worker asked for; joblib gets no generator from Ray
        threads, yields = 1, "list"
    if missing:
        with parallel_workers(workers if engine is Engine.RAY else n_jobs, engine, address):
            jobs = (delayed(_finish)(work, i, tasks[i], paths[i], threads) for i in missing)
            try:
                for i, result in Parallel(return_as=yields, batch_size=1, pre_dispatch="all")(jobs):
                    results[i] = result
                    report()
            except TerminatedWorkerError as exc:
                raise ExperimentError(
                    "a worker process was killed, perhaps because memory ran out; finished results are kept. Run the "
                    "same command again, with fewer workers"
                ) from exc
            finally:
                if engine is Engine.LOCAL and n_jobs > 1:
                    get_reusable_executor().shutdown(wait=True)
    return [result for result in results if result is not None]


def _finish(work: Callable[[Any], Result], i: int, task: Task, path: Path, threads: int | None) -> tuple[int, Result]:
    """Compute one result and store it, in the process that computes."""
    if threads is not None:
        limit_threads(threads)
    result = work(task)
    write_whole(path, json.dumps({"settings": task.settings, "result": result}, indent=1) + "\n")
    return i, result


def limit_threads(threads: int) -> None:
    """Limit ONNX Runtime, OpenCV and linear algebra to so many threads each, for the rest of this process."""
    os.environ["OMP_NUM_THREADS"] = str(threads)  # which the package's pools keep to
    cv2.setNumThreads(threads)
    threadpool_limits(threads)


def _stored(path: Path, settings: Result) -> Result | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or record.get("settings") != json.loads(json.dumps(settings)):
        return None
    result = record.get("result")
    return result if isinstance(result, dict) else None
