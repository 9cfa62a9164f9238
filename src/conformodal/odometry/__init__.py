"""The estimator: trained models, streams and sequences. Every name is imported when it is first used."""

from typing import TYPE_CHECKING, Any

from conformodal.core.late import late

if TYPE_CHECKING:
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
    from .region_rules import EvidenceKind, RegionRules, Sharing
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
    "Sharing",
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

_find = late(
    __name__,
    {
        **dict.fromkeys(("Calibration", "Method", "ModelConfig", "Runtime", "config_of"), ".config"),
        **dict.fromkeys(("ModelFileError", "OdometryError", "ResultsError"), ".errors"),
        **dict.fromkeys(("Estimate", "OdometryRun"), ".estimates"),
        "VisualOdometry": ".estimator",
        **dict.fromkeys(("data_digest", "identify"), ".identity"),
        **dict.fromkeys(
            ("TrainingData", "make_folds", "measure_depths", "prepare_training_data", "train_model"), ".learning"
        ),
        **dict.fromkeys(("Localization", "PoseModel"), ".model"),
        **dict.fromkeys(("MotionRecord", "measure_motions"), ".motions"),
        "Odometry": ".odometry",
        **dict.fromkeys(("PaperOdometry", "odometry_of"), ".paper_odometry"),
        **dict.fromkeys(("METHODS", "ONLINE", "as_trajectory", "rows_by_recording", "whole_paths"), ".paths"),
        **dict.fromkeys(
            (
                "METRES_PER_RAD",
                "PoseRadius",
                "Promise",
                "fit_pose_radius",
                "joint_error",
                "pose_errors",
                "recordings_needed",
            ),
            ".radius",
        ),
        **dict.fromkeys(("EvidenceKind", "RegionRules", "Sharing"), ".region_rules"),
        **dict.fromkeys(
            (
                "METRICS",
                "RegionStatistics",
                "ResultsWriter",
                "iter_region_records",
                "provenance",
                "read_metrics",
                "read_region_parquet",
                "read_region_records",
                "read_trajectories",
                "read_unfinished",
                "records_contain",
                "write_metrics",
                "write_region_parquet",
                "write_run",
            ),
            ".results",
        ),
        **dict.fromkeys(
            ("bounded_coverage", "coverage_table", "error_table", "is_exchangeable", "radius_table"),
            ".results.evaluation",
        ),
        **dict.fromkeys(("calibrate_selection", "recording_errors"), ".selection"),
        **dict.fromkeys(("load_model", "model_digest", "save_model"), ".store"),
        "StreamRunner": ".streaming",
    },
)


def __getattr__(name: str) -> Any:
    return _find(name)
