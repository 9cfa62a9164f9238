"""Interfaces of tasks and of engines that run them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, TypeAlias

Result: TypeAlias = dict[str, Any]
Work: TypeAlias = Callable[[Any], Result]
Progress: TypeAlias = Callable[[str, int, int], None]


class Task(Protocol):
    """Something to be done once."""

    @property
    def key(self) -> str:
        """A file name without its ending, unique among the tasks."""
        ...

    @property
    def group(self) -> str:
        """Tasks of one group share intermediate results: a worker that goes on with its group is faster."""
        ...

    @property
    def settings(self) -> Result:
        """All that decides the result; JSON."""
        ...


class Engine(Protocol):
    """Where tasks are worked out."""

    def results(self, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """Index and result of every task, in whatever order they end.

        Parameters
        ----------
        work
            Turns a task into a result that JSON can hold. Engines with other processes pickle it and the tasks, for
            processes of their own only.
        tasks
            Independent of each other.
        """
        ...
