"""Baselines and comparisons."""

from .ambiguity import AmbiguityCheck, check_ambiguity
from .classical import (
    ClassicalRegressor,
    load_classical,
    opponents_training,
    remove_classical,
    save_classical,
    train_classical,
)
from .engine import Engine, LocalEngine, RayEngine, run_tasks
from .errors import ExperimentError
from .evaluation import coverage_table, error_table, is_exchangeable, radius_table
from .plain import PlainRegressor, train_plain

__all__ = [
    "AmbiguityCheck",
    "ClassicalRegressor",
    "Engine",
    "ExperimentError",
    "LocalEngine",
    "PlainRegressor",
    "RayEngine",
    "check_ambiguity",
    "coverage_table",
    "error_table",
    "is_exchangeable",
    "load_classical",
    "opponents_training",
    "radius_table",
    "remove_classical",
    "run_tasks",
    "save_classical",
    "train_classical",
    "train_plain",
]
