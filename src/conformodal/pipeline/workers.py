"""The workers of a training: processes of this machine, or of a Ray cluster."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

from joblib import parallel_config

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra

_RETRIES = {"max_restarts": 3, "max_task_retries": 3}  # what a cluster's lost worker was at, so often


class Engine(StrEnum):
    """Whose processes workers are: those of this machine, or of a Ray cluster."""

    LOCAL = "local"
    RAY = "ray"


@contextmanager
def parallel_workers(number: int | None, engine: Engine = Engine.LOCAL, address: str | None = None) -> Iterator[None]:
    """So many workers for joblib; None is one on this machine, and one for each core of a Ray cluster, the most.

    The cluster is the one at an address, or the one that Ray finds or starts. What a lost worker was at is done again.
    """
    if engine is Engine.LOCAL:
        with parallel_config("loky", n_jobs=number or 1):
            yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anyone
    # a thread that failed work leaves behind must not connect again
    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
    with require_extra("ray", "the engine 'ray'"):
        import ray  # noqa: PLC0415 - an extra
        from ray.util.joblib import register_ray  # noqa: PLC0415
    stop = signal.getsignal(signal.SIGTERM)
    try:
        cluster = ray.init(address, include_dashboard=False, log_to_driver=False, logging_level="error")
    except (ConnectionError, RuntimeError, ValueError) as exc:
        raise ConformodalError(f"no Ray cluster at {address!r}: {exc}") from exc
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, stop)  # which Ray has taken for itself
    register_ray()
    cores = int(ray.cluster_resources()["CPU"])
    n_jobs = min(number or cores, cores)
    with cluster, parallel_config("ray", n_jobs=n_jobs, max_nbytes=None, ray_remote_args=_RETRIES):
        yield
