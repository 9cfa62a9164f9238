"""``conformodal evaluate``: results against a truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.datasets import Layout
from conformodal.experiments import error_table
from conformodal.odometry import (
    TARGET_NAMES,
    OdometryError,
    provenance,
    read_metrics,
    read_region_records,
    read_trajectories,
    records_contain,
    write_metrics,
)
from conformodal.poses import Alignment, Trajectory, align, associate, kitti_drift, read_tum, recall, relative_errors
from conformodal.poses.drift import KITTI_LENGTHS_M

from .console import console, kind_errors, print_errors, print_where
from .sources import open_sequence


@kind_errors
def evaluate(
    out: Annotated[Path, typer.Argument(help="Folder of results that run wrote.")],
    truth: Annotated[Path, typer.Option(help="True poses: a TUM trajectory, or a data set with poses.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout, if it is a data set.")] = Layout.AUTO,
    alignment: Annotated[
        Alignment, typer.Option("--align", help="What each trajectory may be moved by before it is compared.")
    ] = Alignment.NONE,
) -> None:
    """Compare results with the truth; pairs poses by time, within 0.01 s. Writes OUT/evaluation/metrics.json."""
    metrics = read_metrics(out)
    trajectories = read_trajectories(out)
    records = read_region_records(out / "regions.jsonl")
    true_poses = read_truth(truth, layout)
    answer = next(iter(trajectories.values()))
    if any(len(t) != len(answer) for t in trajectories.values()) or len(records) != len(answer):
        raise OdometryError(f"{out}: trajectories and regions differ in length; was a run overwritten half-way?")
    mine, theirs = associate(answer, true_poses)
    matched = true_poses[theirs]
    moved = {name: align(t[mine], matched, alignment) for name, t in trajectories.items()}
    errors = {name: row | motion_errors(moved[name], matched) for name, row in error_table(moved, matched).items()}
    sign = np.array(metrics["sign_reference_quat_wxyz"])
    inside = records_contain([records[i] for i in mine], matched, sign)
    result: dict[str, Any] = {
        "command": "evaluate",
        "provenance": provenance(),
        "configuration": {"results": metrics["configuration"], "truth": truth.name, "align": alignment},
        "seed": metrics["seed"],
        "n_matched": len(mine),
        "n_answered": len(answer),
        "errors": errors,
        "coverage": {
            "targets": dict(zip(TARGET_NAMES, inside.mean(axis=0).tolist(), strict=True)),
            "joint_coverage": float(inside.all(axis=1).mean()),
            "note": "share of true poses in the stored intervals; whether alpha promises it depends on how these "
            "frames relate to the calibration frames",
        },
    }
    write_metrics(out / "evaluation", result)
    console.print(f"{len(mine)} of {len(answer)} poses have a true one within 0.01 s")
    moved_by = "" if alignment is Alignment.NONE else f", aligned by {alignment}"
    print_errors(errors, f"against {truth.name}{moved_by}")
    console.print(f"whole pose covered {result['coverage']['joint_coverage']:.3f}")
    print_where(out / "evaluation")


def motion_errors(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Recall; relative errors from pose to pose; and KITTI's drift where the path is long enough."""
    found: dict[str, Any] = {"recall": recall(estimate, truth)}
    if len(truth) > 1:
        metres, degrees = relative_errors(estimate, truth)
        found |= {"rpe_rmse_m": float(np.sqrt(np.mean(metres**2))), "rpe_rmse_deg": float(np.sqrt(np.mean(degrees**2)))}
    length = float(np.sum(np.linalg.norm(np.diff(truth.positions_xyz, axis=0), axis=1)))
    if length > KITTI_LENGTHS_M[0]:
        drift = kitti_drift(estimate, truth)
        found |= {"drift_percent": drift.translation_percent, "drift_deg_per_m": drift.rotation_deg_per_m}
    return found


def read_truth(path: Path, layout: Layout) -> Trajectory:
    """True poses from a TUM file or a data set."""
    if path.is_dir():
        return open_sequence(path, layout, require_poses=True).require_truth()
    return read_tum(path)
