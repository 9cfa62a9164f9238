"""Tasks on a Ray cluster (extra ``ray``)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import ExperimentError
from .engines import Result, Task, Work
from .threads import limit_threads


@dataclass(frozen=True)
class RayEngine:
    """A Ray cluster, one CPU a task.

    Data, cache and output folders must be at the same paths on every machine of the cluster, as on a shared disk. A
    worker that dies is replaced, and its task is tried again.

    Attributes
    ----------
    address
        Of a running cluster, ``"auto"`` for the one that this machine belongs to; None starts one on this machine
        alone, with a CPU for every core.
    """

    address: str | None = None

    def results(self, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """See :class:`~conformodal.experiments.engine.Engine`.

        Raises
        ------
        ExperimentError
            If Ray is not installed, or there is no cluster at the address.
        """
        ray = _ray()
        ours = not ray.is_initialized()
        if ours:
            try:
                ray.init(address=self.address, include_dashboard=False, log_to_driver=False)
            except (ConnectionError, ValueError, RuntimeError) as exc:
                raise ExperimentError(f"no Ray cluster at {self.address!r}: {exc}") from exc
        try:
            shared = ray.put(work)
            remote = ray.remote(num_cpus=1, max_retries=2)(_work)
            waiting = {remote.remote(shared, task): i for i, task in enumerate(tasks)}
            while waiting:
                ready, _ = ray.wait(list(waiting), num_returns=1)
                for reference in ready:
                    yield waiting.pop(reference), _got(ray, reference)
        finally:
            if ours:
                ray.shutdown()


def _got(ray: Any, reference: Any) -> Result:
    try:
        result: Result = ray.get(reference)
    except ray.exceptions.RayTaskError as exc:
        raise exc.cause from exc  # the task's own error, as on one machine
    return result


def _work(work: Work, task: Task) -> Result:
    limit_threads(1)  # the CPU that the task asked for
    return work(task)


def _ray() -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anyone
    try:
        import ray  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as exc:
        raise ExperimentError("the engine 'ray' needs Ray: pip install 'conformodal[ray]'") from exc
    return ray
