"""Independent tasks, on one machine or on a cluster; results are kept, and a run that was stopped goes on."""

from .cluster import RayEngine
from .engines import Engine
from .local import LocalEngine
from .tasks import run_tasks

__all__ = ["Engine", "LocalEngine", "RayEngine", "run_tasks"]
