"""Baselines and comparisons."""

from .ambiguity import AmbiguityCheck, check_ambiguity
from .classical import (
    ClassicalRegressor,
    baseline_training,
    train_classical,
)
from .compared_paths import comparison_paths
from .engine import Engine, LocalEngine, RayEngine, run_tasks
from .errors import ExperimentError
from .plain import PlainRegressor, train_plain

__all__ = [
    "AmbiguityCheck",
    "ClassicalRegressor",
    "Engine",
    "ExperimentError",
    "LocalEngine",
    "PlainRegressor",
    "RayEngine",
    "baseline_training",
    "check_ambiguity",
    "comparison_paths",
    "run_tasks",
    "train_classical",
    "train_plain",
]
