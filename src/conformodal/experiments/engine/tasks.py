"""Tasks whose results are kept one file each: a run that was stopped goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from conformodal.core.files import write_whole

from ..errors import ExperimentError
from .engines import Engine, Progress, Result, Task, Work
from .local import LocalEngine


def run_tasks(
    tasks: Sequence[Task],
    work: Work,
    folder: Path,
    progress: Progress | None = None,
    engine: Engine | None = None,
) -> list[Result]:
    """Results of all tasks, in their order; those on disk with the same settings are not worked out again.

    Parameters
    ----------
    tasks
        With keys of their own.
    work
        Turns a task into a result that JSON can hold.
    folder
        Where results are kept, each as soon as it is there; created if missing.
    progress
        Called with ``"tasks"``, tasks done and tasks in all.
    engine
        Where to work; in this process by default.

    Raises
    ------
    ExperimentError
        If two tasks share a key.
    """
    keys = [task.key for task in tasks]
    twice = sorted({k for k in keys if keys.count(k) > 1})
    if twice:
        raise ExperimentError(f"tasks need keys of their own, found twice: {twice}")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{key}.json" for key in keys]
    results = [_kept(path, task.settings) for path, task in zip(paths, tasks, strict=True)]
    missing = [i for i, result in enumerate(results) if result is None]

    def report() -> None:
        if progress is not None:
            progress("tasks", sum(result is not None for result in results), len(tasks))

    report()
    for k, result in (engine or LocalEngine()).results(work, [tasks[i] for i in missing]):
        results[missing[k]] = result
        _keep(paths[missing[k]], tasks[missing[k]].settings, result)
        report()
    return [result for result in results if result is not None]


def _kept(path: Path, settings: Result) -> Result | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or record.get("settings") != json.loads(json.dumps(settings)):
        return None
    result = record.get("result")
    return result if isinstance(result, dict) else None


def _keep(path: Path, settings: Result, result: Result) -> None:
    write_whole(path, json.dumps({"settings": settings, "result": result}, indent=1) + "\n")
