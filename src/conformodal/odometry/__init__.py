"""The estimator: trained models, streams and sequences."""

from .errors import ModelFileError, OdometryError, ResultsError
from .estimator import METHODS, Estimate, OdometryRun, VisualOdometry
from .model import PoseModel
from .motions import MotionRecord, measure_motions
from .provenance import provenance
from .radius import PoseRadius, Promise, fit_pose_radius, pose_errors
from .results import (
    METRICS,
    read_metrics,
    read_region_records,
    read_trajectories,
    records_contain,
    write_metrics,
    write_run,
)
from .selection import calibrate_selection, recording_errors
from .store import load_model, save_model
from .targets import TARGET_NAMES, pose_targets
from .training import ModelConfig, TrainingData, data_digest, prepare_training_data, train_model

__all__ = [
    "METHODS",
    "METRICS",
    "TARGET_NAMES",
    "Estimate",
    "ModelConfig",
    "ModelFileError",
    "MotionRecord",
    "OdometryError",
    "OdometryRun",
    "PoseModel",
    "PoseRadius",
    "Promise",
    "ResultsError",
    "TrainingData",
    "VisualOdometry",
    "calibrate_selection",
    "data_digest",
    "fit_pose_radius",
    "load_model",
    "measure_motions",
    "pose_errors",
    "pose_targets",
    "prepare_training_data",
    "provenance",
    "read_metrics",
    "read_region_records",
    "read_trajectories",
    "recording_errors",
    "records_contain",
    "save_model",
    "train_model",
    "write_metrics",
    "write_run",
]
