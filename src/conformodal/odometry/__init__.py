"""The estimator: trained models, streams and sequences."""

from .errors import ModelFileError, OdometryError, ResultsError
from .estimator import METHODS, Estimate, OdometryRun, VisualOdometry
from .model import PoseModel
from .provenance import provenance
from .results import (
    read_metrics,
    read_region_records,
    read_trajectories,
    records_contain,
    write_metrics,
    write_run,
)
from .store import load_model, save_model
from .targets import TARGET_NAMES, pose_targets
from .training import ModelConfig, TrainingData, data_digest, prepare_training_data, train_model

__all__ = [
    "METHODS",
    "TARGET_NAMES",
    "Estimate",
    "ModelConfig",
    "ModelFileError",
    "OdometryError",
    "OdometryRun",
    "PoseModel",
    "ResultsError",
    "TrainingData",
    "VisualOdometry",
    "data_digest",
    "load_model",
    "pose_targets",
    "prepare_training_data",
    "provenance",
    "read_metrics",
    "read_region_records",
    "read_trajectories",
    "records_contain",
    "save_model",
    "train_model",
    "write_metrics",
    "write_run",
]
