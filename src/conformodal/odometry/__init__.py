"""The estimator: trained models, streams and sequences."""

from .answers import METHODS, OtherMethods, answers, as_trajectory
from .config import ModelConfig
from .depths import measure_depths
from .errors import ModelFileError, OdometryError, ResultsError
from .estimates import Estimate, OdometryRun
from .estimator import VisualOdometry
from .fix_scale import FixScale
from .identity import Found, FrameIdentities, data_digest, identify
from .landmarks import Fixes, LandmarkRegions, Landmarks, fit_landmarks
from .model import PoseModel
from .motions import MotionRecord, measure_motions
from .parquet import read_region_parquet, write_region_parquet
from .provenance import provenance
from .radius import PoseRadius, Promise, fit_pose_radius, pose_errors
from .records import METRICS, iter_region_records, read_region_records, records_contain
from .results import read_metrics, read_trajectories, write_metrics, write_run
from .scene import Scene, learn_scene
from .selection import calibrate_selection, recording_errors
from .store import load_model, save_model
from .streaming import StreamRunner
from .tally import RegionTally
from .targets import TARGET_NAMES, pose_targets, target_scale
from .training import TrainingData, prepare_training_data, train_model
from .writer import ResultsWriter

__all__ = [
    "METHODS",
    "METRICS",
    "TARGET_NAMES",
    "Estimate",
    "FixScale",
    "Fixes",
    "Found",
    "FrameIdentities",
    "LandmarkRegions",
    "Landmarks",
    "ModelConfig",
    "ModelFileError",
    "MotionRecord",
    "OdometryError",
    "OdometryRun",
    "OtherMethods",
    "PoseModel",
    "PoseRadius",
    "Promise",
    "RegionTally",
    "ResultsError",
    "ResultsWriter",
    "Scene",
    "StreamRunner",
    "TrainingData",
    "VisualOdometry",
    "answers",
    "as_trajectory",
    "calibrate_selection",
    "data_digest",
    "fit_landmarks",
    "fit_pose_radius",
    "identify",
    "iter_region_records",
    "learn_scene",
    "load_model",
    "measure_depths",
    "measure_motions",
    "pose_errors",
    "pose_targets",
    "prepare_training_data",
    "provenance",
    "read_metrics",
    "read_region_parquet",
    "read_region_records",
    "read_trajectories",
    "recording_errors",
    "records_contain",
    "save_model",
    "target_scale",
    "train_model",
    "write_metrics",
    "write_region_parquet",
    "write_run",
]
