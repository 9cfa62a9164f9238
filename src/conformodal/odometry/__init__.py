"""The estimator: trained models, streams and sequences."""

from .config import Calibration, Method, ModelConfig, Runtime, config_of
from .errors import ModelFileError, OdometryError, ResultsError
from .estimates import Estimate, OdometryRun
from .estimator import VisualOdometry
from .identity import data_digest, identify
from .learning import TrainingData, make_folds, measure_depths, prepare_training_data, train_model
from .model import Localization, PoseModel
from .motions import MotionRecord, measure_motions
from .odometry import Odometry
from .paper_odometry import PaperOdometry, odometry_of
from .paths import METHODS, ONLINE, as_trajectory, rows_by_recording, whole_paths
from .radius import (
    METRES_PER_RAD,
    PoseRadius,
    Promise,
    fit_pose_radius,
    joint_error,
    pose_errors,
    recordings_needed,
)
from .region_rules import EvidenceKind, RegionRules
from .results import (
    METRICS,
    RegionStatistics,
    ResultsWriter,
    iter_region_records,
    provenance,
    read_metrics,
    read_region_parquet,
    read_region_records,
    read_trajectories,
    read_unfinished,
    records_contain,
    write_metrics,
    write_region_parquet,
    write_run,
)
from .results.evaluation import bounded_coverage, coverage_table, error_table, is_exchangeable, radius_table
from .selection import calibrate_selection, recording_errors
from .store import load_model, model_digest, save_model
from .streaming import StreamRunner

__all__ = [
    "METHODS",
    "METRES_PER_RAD",
    "METRICS",
    "ONLINE",
    "Calibration",
    "Estimate",
    "EvidenceKind",
    "Localization",
    "Method",
    "ModelConfig",
    "ModelFileError",
    "MotionRecord",
    "Odometry",
    "OdometryError",
    "OdometryRun",
    "PaperOdometry",
    "PoseModel",
    "PoseRadius",
    "Promise",
    "RegionRules",
    "RegionStatistics",
    "ResultsError",
    "ResultsWriter",
    "Runtime",
    "StreamRunner",
    "TrainingData",
    "VisualOdometry",
    "as_trajectory",
    "bounded_coverage",
    "calibrate_selection",
    "config_of",
    "coverage_table",
    "data_digest",
    "error_table",
    "fit_pose_radius",
    "identify",
    "is_exchangeable",
    "iter_region_records",
    "joint_error",
    "load_model",
    "make_folds",
    "measure_depths",
    "measure_motions",
    "model_digest",
    "odometry_of",
    "pose_errors",
    "prepare_training_data",
    "provenance",
    "radius_table",
    "read_metrics",
    "read_region_parquet",
    "read_region_records",
    "read_trajectories",
    "read_unfinished",
    "recording_errors",
    "recordings_needed",
    "records_contain",
    "rows_by_recording",
    "save_model",
    "train_model",
    "whole_paths",
    "write_metrics",
    "write_region_parquet",
    "write_run",
]
