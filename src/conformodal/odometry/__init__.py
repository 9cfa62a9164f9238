"""The estimator: trained models, streams and sequences."""

from .answers import METHODS, OtherMethods, answers, as_trajectory
from .config import Method, ModelConfig
from .depths import measure_depths
from .errors import ModelFileError, OdometryError, ResultsError
from .estimates import Estimate, OdometryRun
from .estimator import VisualOdometry
from .fix_scale import FixScale
from .folds import Calibration, make_folds
from .identity import Found, FrameIdentities, data_digest, identify
from .known import KnownPlaces
from .landmarks import Fixes, Landmarks, fit_landmarks
from .model import PoseModel
from .motions import MotionRecord, measure_motions
from .paper import PaperOdometry, odometry_of, paper_motions
from .parquet import read_region_parquet, write_region_parquet
from .provenance import provenance
from .radius import PoseRadius, Promise, fit_pose_radius, pose_errors, recordings_needed
from .records import METRICS, iter_region_records, read_region_records, records_contain
from .region_rules import Evidence, RegionRules, trusted
from .results import read_metrics, read_trajectories, read_unfinished, write_metrics, write_run
from .scene import Scene, learn_scene
from .selection import calibrate_selection, recording_errors, recording_sizes
from .sizing import METRES_PER_RAD, Sizing, depth_or_default, joint_error, recording_size, roughness
from .store import load_model, model_digest, save_model
from .streaming import StreamRunner
from .tally import RegionTally
from .targets import TARGET_NAMES, pose_targets, target_scale
from .training import prepare_training_data, train_model
from .training_data import TrainingData
from .writer import ResultsWriter

__all__ = [
    "METHODS",
    "METRES_PER_RAD",
    "METRICS",
    "TARGET_NAMES",
    "Calibration",
    "Estimate",
    "Evidence",
    "FixScale",
    "Fixes",
    "Found",
    "FrameIdentities",
    "KnownPlaces",
    "Landmarks",
    "Method",
    "ModelConfig",
    "ModelFileError",
    "MotionRecord",
    "OdometryError",
    "OdometryRun",
    "OtherMethods",
    "PaperOdometry",
    "PoseModel",
    "PoseRadius",
    "Promise",
    "RegionRules",
    "RegionTally",
    "ResultsError",
    "ResultsWriter",
    "Scene",
    "Sizing",
    "StreamRunner",
    "TrainingData",
    "VisualOdometry",
    "answers",
    "as_trajectory",
    "calibrate_selection",
    "data_digest",
    "depth_or_default",
    "fit_landmarks",
    "fit_pose_radius",
    "identify",
    "iter_region_records",
    "joint_error",
    "learn_scene",
    "load_model",
    "make_folds",
    "measure_depths",
    "measure_motions",
    "model_digest",
    "odometry_of",
    "paper_motions",
    "pose_errors",
    "pose_targets",
    "prepare_training_data",
    "provenance",
    "read_metrics",
    "read_region_parquet",
    "read_region_records",
    "read_trajectories",
    "read_unfinished",
    "recording_errors",
    "recording_size",
    "recording_sizes",
    "recordings_needed",
    "records_contain",
    "roughness",
    "save_model",
    "target_scale",
    "train_model",
    "trusted",
    "write_metrics",
    "write_region_parquet",
    "write_run",
]
