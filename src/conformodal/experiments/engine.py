"""Independent tasks whose results are kept one file each: a run that was stopped goes on where it was."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from .errors import ExperimentError

Result = dict[str, Any]
Progress = Callable[[str, int, int], None]


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


T = TypeVar("T", bound=Task)


def run_tasks(
    tasks: Sequence[T], work: Callable[[T], Result], folder: Path, progress: Progress | None = None
) -> list[Result]:
    """Results of all tasks, in their order; those on disk with the same settings are not worked out again.

    Parameters
    ----------
    tasks
        With keys of their own.
    work
        Turns a task into a result that JSON can hold.
    folder
        Where results are kept, created if missing.
    progress
        Called with ``"tasks"``, tasks done and tasks in all.

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
    results = []
    for done, task in enumerate(tasks):
        if progress is not None:
            progress("tasks", done, len(tasks))
        path = folder / f"{task.key}.json"
        result = _kept(path, task.settings)
        if result is None:
            result = work(task)
            _keep(path, task.settings, result)
        results.append(result)
    if progress is not None:
        progress("tasks", len(tasks), len(tasks))
    return results


def _kept(path: Path, settings: Result) -> Result | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or record.get("settings") != json.loads(json.dumps(settings)):
        return None
    result = record.get("result")
    return result if isinstance(result, dict) else None


def _keep(path: Path, settings: Result, result: Result) -> None:
    """Written beside and moved into place: a killed run leaves no half result."""
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps({"settings": settings, "result": result}, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
