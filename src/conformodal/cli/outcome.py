"""What a run found, as ``metrics.json``, as a page, and on the terminal."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.datasets import Sequence
from conformodal.experiments import (
    ClassicalRegressor,
    coverage_table,
    error_table,
    is_exchangeable,
    radius_table,
)
from conformodal.odometry import OdometryError, PoseModel, RegionTally, data_digest, provenance
from conformodal.poses import Trajectory

from .console import console, print_errors


class Part(StrEnum):
    """Which frames of a source to answer."""

    ALL = "all"
    TRAIN = "train"
    CALIBRATION = "calibration"
    TEST = "test"


@dataclass(frozen=True, eq=False)
class Known:
    """True poses of the answered frames, and what is known of their regions."""

    truth: Trajectory
    regions: RegionTally


def part_frames(model: PoseModel, sequence: Sequence, part: Part) -> npt.NDArray[np.int64] | None:
    """Frames of a part of the model's own data set; None for all.

    Raises
    ------
    OdometryError
        If it is another data set.
    """
    if part is Part.ALL:
        return None
    if data_digest(sequence) != model.data_digest:
        raise OdometryError(
            f"{sequence.name}: is not the data set the model was trained on ({model.configuration['data']}), so it has "
            f"no {part} part; run on all of it"
        )
    return model.split.part(str(part))


def run_metrics(
    model: PoseModel,
    classical: ClassicalRegressor | None,
    part: Part,
    trajectories: dict[str, Trajectory],
    known: Known | None,
    counts: dict[str, Any],
    *,
    whole: bool = True,
    fixed_all: bool = True,
) -> dict[str, Any]:
    """The content of ``metrics.json``.

    Parameters
    ----------
    model, classical, part
        What was run, and on which frames.
    trajectories
        By method; may be empty where nothing is known to compare them with.
    known
        What errors and coverage need.
    counts
        Numbers of frames and seconds.
    whole
        Whether every frame of the part was answered, as in calibration: what is promised is promised for these only.
    fixed_all
        Whether landmarks were looked for in all of them, as when a radius is calibrated.
    """
    metrics: dict[str, Any] = {
        "command": "run",
        "provenance": provenance(),
        "configuration": {**model.configuration, "alpha": float(model.calibration.alpha), "part": str(part)},
        "seed": model.split.seed,
        "split": str(model.split.kind),
        "split_note": _split_note(model, part),
        "sign_reference_quat_wxyz": model.sign_reference.tolist(),
        **counts,
    }
    if classical is not None:
        metrics["classical_training"] = asdict(classical.training)
    # whole recordings calibrated it: some of a recording's frames alone are answered otherwise, and it says nothing
    radius = model.radius if whole and fixed_all and part is Part.ALL else None
    metrics["radius"] = radius_table(radius, trajectories, None if known is None else known.truth)
    if known is not None:
        metrics["errors"] = error_table(trajectories, known.truth)
        exchangeable = whole and is_exchangeable(model, str(part))
        metrics["coverage"] = coverage_table(known.regions, model, exchangeable=exchangeable, fixed_all=fixed_all)
    return metrics


def summary(name: str, metrics: dict[str, Any]) -> list[str]:
    """The page's first lines."""
    lines = [
        f"{name}: {metrics['n_answered']} frames answered, {metrics['split_note']}",
        f"{metrics['n_unreliable']} frames without reliable motion, {metrics['n_without_image']} without an image; "
        f"landmarks recognised in {metrics['n_fixed']}.",
    ]
    if metrics["radius"] is not None:
        radius = metrics["radius"]
        lines.append(f"The {radius['method']} pose has a radius of {_size(radius)}. {radius['assumption']}")
    if metrics.get("stopped"):
        lines.append(f"Stopped early: {metrics['stopped']}. Everything before is here.")
    return lines


def say(metrics: dict[str, Any], *, whole_space: bool) -> None:
    """The result on the terminal."""
    lost = f", {metrics['n_without_image']} without an image" if metrics["n_without_image"] else ""
    fixed = f", landmarks recognised in {metrics['n_fixed']}" if metrics["n_fixed"] else ""
    console.print(f"{metrics['n_answered']} frames, {metrics['n_unreliable']} without reliable motion{fixed}{lost}")
    for name, why in list(metrics["problems"].items())[:3]:
        console.print(f"  {name}: {why}", soft_wrap=True, markup=False)
    if whole_space:
        console.print(
            "[bold]The region is the whole space in some target[/]: too few calibration frames for this alpha, or too "
            "many of them beyond the training range."
        )
    if metrics["radius"] is not None:
        console.print(f"radius of the {metrics['radius']['method']} pose: {_size(metrics['radius'])}")
    if "errors" in metrics:
        print_errors(metrics["errors"], metrics["split_note"])
        coverage = metrics["coverage"]
        console.print(
            f"whole pose covered {coverage['joint_coverage']:.3f}, alpha = {coverage['alpha']} ({coverage['joint']}). "
            + coverage["assumption"],
            soft_wrap=True,
        )


def _size(radius: dict[str, Any]) -> str:
    if radius["radius_m"] is None or radius["radius_deg"] is None:
        return "infinity, for want of recordings to calibrate it on"
    return f"{radius['radius_m']:.4f} m and {radius['radius_deg']:.2f} degrees"


def _split_note(model: PoseModel, part: Part) -> str:
    if part is Part.ALL:
        return "all frames of the source (parts of the training data among them, if it is the same)."
    return f"the {part} part of split {model.split.kind}, seed {model.split.seed}."
