"""Baselines, comparisons and the tables of the paper."""

from .ambiguity import AmbiguityCheck, check_ambiguity
from .classical import (
    baseline_training,
    train_classical,
)
from .compared_paths import comparison_paths
from .engine import Engine, LocalEngine, RayEngine, run_tasks
from .errors import ExperimentError
from .plain import train_plain

__all__ = [
    "AmbiguityCheck",
    "Engine",
    "ExperimentError",
    "LocalEngine",
    "RayEngine",
    "baseline_training",
    "check_ambiguity",
    "comparison_paths",
    "run_tasks",
    "train_classical",
    "train_plain",
]
