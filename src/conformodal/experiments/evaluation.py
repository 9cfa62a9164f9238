"""Judging a run: errors of every method, and coverage of the regions beside its exact band."""

from __future__ import annotations

from typing import Any

import numpy as np

from conformodal.conformal import check_coverage
from conformodal.datasets import SplitKind
from conformodal.odometry import TARGET_NAMES, PoseModel, PoseRadius, RegionTally
from conformodal.poses import Trajectory, trajectory_errors

ASSUMPTION_HELD = (
    "Frames were split at random, so calibration and test frames are exchangeable: per target, the covered count "
    "follows the Beta-binomial law whose central 99 % is the band."
)
ASSUMPTION_MIXED = (
    "Frames were split at random, so calibration and test frames are exchangeable, and every region keeps its promise. "
    "Landmarks were looked for in some frames only: there are two calibrations, and no exact band for the count."
)
ASSUMPTION_BROKEN = (
    "The evaluated frames are not the ones, or not all of them, that were held out at random, one by one, together "
    "with the calibration frames, so the two are not exchangeable: coverage here is an observation, and no guarantee "
    "applies."
)


def error_table(trajectories: dict[str, Trajectory], truth: Trajectory) -> dict[str, dict[str, float]]:
    """``rmse_m``, ``rmse_deg`` and medians of every trajectory, by its name."""
    return {name: trajectory_errors(trajectory, truth) for name, trajectory in trajectories.items()}


def coverage_table(
    tally: RegionTally, model: PoseModel, *, exchangeable: bool, fixed_all: bool = True
) -> dict[str, Any]:
    """Coverage and size of the regions.

    Parameters
    ----------
    tally
        Of the regions of the frames that were answered.
    model
        Gives alpha and the number of calibration frames.
    exchangeable
        Whether these frames are exchangeable with the calibration frames: the test part of an ``interleaved``
        split.
    fixed_all
        Whether landmarks were looked for in all of them. Otherwise there were two calibrations, each of which keeps
        its promise. A band is stated for frames that are exchangeable and have one calibration.
    """
    inside = tally.inside
    calibration = model.calibration_of(with_fixes=fixed_all)
    one_law = exchangeable and (fixed_all or model.landmark_regions is None)
    targets: dict[str, Any] = {}
    for j, name in enumerate(TARGET_NAMES):
        row: dict[str, Any] = {
            "coverage": float(inside[:, j].mean()),
            "mean_length": _finite(tally.length[:, j].mean()),
            "mean_intervals": float(tally.n_intervals[:, j].mean()),
        }
        if one_law and calibration.joint != "max":
            check = check_coverage(inside[:, j], model.n_calibration, calibration.alpha_per_target)
            row |= {"band_99": [check.low, check.high], "inside_band": check.inside}
        targets[name] = row
    held = np.asarray(inside.all(axis=1))
    together = check_coverage(held, model.n_calibration, calibration.alpha) if calibration.joint == "max" else None
    return {
        "alpha": float(calibration.alpha),
        "joint": calibration.joint,
        "alpha_per_target": float(calibration.alpha_per_target),
        "score": calibration.score.name,
        "n_calibration": model.n_calibration,
        "n_evaluated": len(tally),
        "whole_space": bool(tally.unbounded.any()),
        "targets": targets,
        "joint_coverage": float(held.mean()),
        "joint_band_99": [together.low, together.high] if together and one_law else None,
        "median_position_volume_m3": _finite(np.median(tally.length[:, :3].prod(axis=1))),
        "regions_from": _regions_from(model, fixed_all=fixed_all),
        "assumption": (ASSUMPTION_HELD if one_law else ASSUMPTION_MIXED) if exchangeable else ASSUMPTION_BROKEN,
    }


def radius_table(
    radius: PoseRadius | None, trajectories: dict[str, Trajectory], truth: Trajectory | None
) -> dict[str, Any] | None:
    """The chosen pose's radius, what it promises, and how many frames it held if the truth is known."""
    if radius is None:
        return None
    held = None if truth is None else float(radius.holds(trajectories[radius.method], truth).mean())
    return {
        "radius_m": _finite(radius.radius_m),
        "radius_deg": _finite(np.degrees(radius.radius_rad)),
        "alpha": radius.alpha,
        "promise": str(radius.promise),
        "method": radius.method,
        "n_recordings": radius.n_recordings,
        "share_held": held,
        "assumption": radius.assumption,
    }


def is_exchangeable(model: PoseModel, part: str | None) -> bool:
    """Whether the guarantee reaches a part, if all its frames are answered: only the test part of ``interleaved``."""
    return part == "test" and model.split.kind is SplitKind.INTERLEAVED


def _regions_from(model: PoseModel, *, fixed_all: bool) -> str:
    """What the regions rest on, for people."""
    if model.landmark_regions is None:
        return "the image's softmax"
    where = "" if fixed_all else " in those frames where they were looked for"
    return f"the image's softmax, and landmarks of the training part{where}"


def _finite(value: np.floating[Any] | float) -> float | None:
    """JSON has no infinity; None says whole space."""
    return float(value) if np.isfinite(value) else None
