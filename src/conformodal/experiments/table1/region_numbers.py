"""Coverage and size of a run's regions, with landmarks and without."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import Regions, SplitConformal
from conformodal.core import FloatArray
from conformodal.localization import Beliefs, FrameEvidence, pose_targets
from conformodal.odometry import OdometryRun, PoseModel
from conformodal.odometry.learning.calibrating import score_beliefs
from conformodal.poses import Trajectory

from .conditions import ALPHA
from .size_against_error import rank_correlation

_RELIABILITY_ALPHAS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


def region_numbers(
    run: OdometryRun, model: PoseModel, features: npt.NDArray[np.float32], truth: Trajectory
) -> dict[str, Any]:
    """Coverage and size of the answer's regions and, under ``alone``, of those without local features."""
    plain, targets = model.localize(FrameEvidence(features)), pose_targets(truth, model.sign_reference)
    error = position_error(run, truth)
    return {
        **_numbers(run.regions, model, run.localization.beliefs, targets, error, local=True),
        "alone": _numbers(plain.regions, model, plain.beliefs, targets, error, local=False),
        "n_calibration": model.n_calibration,
        "n_test": len(targets),
    }


def paper_numbers(run: OdometryRun, model: PoseModel, truth: Trajectory) -> dict[str, Any]:
    """Coverage and size of the regions of the paper's system, calibrated target by target."""
    rule, targets = model.calibration, pose_targets(truth, model.sign_reference)
    scores = rule.score_samples(run.localization.beliefs.proba, targets)
    error = position_error(run, truth)
    numbers = _summary(run.regions, run.regions, rule, scores, model, targets, error)
    return {**numbers, "n_calibration": model.n_calibration, "n_test": len(targets)}


def _numbers(
    regions: Regions,
    model: PoseModel,
    beliefs: Beliefs,
    targets: FloatArray,
    error: FloatArray,
    *,
    local: bool,
) -> dict[str, Any]:
    """Coverage and size of the whole pose at alpha, and of each target at alpha as in the paper."""
    rule = model.calibration_of(local=local)
    single = SplitConformal(rule.bins, ALPHA, rule.score, "none").calibrate_scores(rule.scores_, rule.groups_)
    each = model.regions(beliefs, np.tile(single.thresholds_, (len(beliefs), 1)))
    scores = score_beliefs(rule, model.localizer, beliefs, targets)
    return _summary(regions, each, single, scores, model, targets, error)


def _summary(
    regions: Regions,
    each: Regions,
    single: SplitConformal,
    scores: npt.NDArray[np.floating[Any]],
    model: PoseModel,
    targets: FloatArray,
    error: FloatArray,
) -> dict[str, Any]:
    rank = rank_correlation(position_size(regions, model), error)
    return {
        "joint_coverage": float(regions.contains(targets, joint=True).mean()),
        "abstained": float(regions.unbounded.any(axis=1).mean()),  # which count as covered
        "coverage": float(each.contains(targets).mean()),
        "length": in_deviations(np.minimum(each.length, _widths(model)), targets),
        "intervals": float(each.n_intervals.mean()),
        "size_error_rank_correlation": rank if np.isfinite(rank) else None,
        # per target, mean over the seven: what the reliability figure shows
        "coverage_at": [[a, float((scores <= single.at(a).thresholds_).mean())] for a in _RELIABILITY_ALPHAS],
    }


def position_size(regions: Regions, model: PoseModel) -> FloatArray:
    """Size of the position's region, metres, a frame."""
    return np.asarray(np.linalg.norm(np.minimum(regions.length, _widths(model))[:, :3], axis=1))


def position_error(run: OdometryRun, truth: Trajectory) -> FloatArray:
    """Error of the smoothed answer, metres, a frame."""
    return np.asarray(np.linalg.norm(run.trajectory.positions_xyz - truth.positions_xyz, axis=1))


def in_deviations(length: FloatArray, targets: FloatArray) -> list[float]:
    """Mean lengths of the targets' sets, in standard deviations of the test targets."""
    return list((length.mean(axis=0) / targets.std(axis=0)).tolist())


def _widths(model: PoseModel) -> FloatArray:
    """Ranges of the bins, which stand for the length of the whole line."""
    return np.array([e[-1] - e[0] for e in model.bins.edges_])
