"""``conformodal evaluate``: results against a truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.files import writing_in
from conformodal.core.words import counted, noun_for
from conformodal.geometry import Alignment, Trajectory, align, associate, poses_at, recall, relative_errors
from conformodal.geometry.alignment import straightness
from conformodal.geometry.metrics import KITTI_LENGTHS_M, MAX_GAP_S, clock_hint, kitti_drift
from conformodal.io import Layout
from conformodal.localizer.targets import TARGET_NAMES
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.evaluate import bounded_coverage, error_table
from conformodal.pipeline.results.folders import check_belongs, lock_output, recover, result_digests
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.results.records import (
    METRICS,
    REGIONS,
    read_region_records,
    record_bounded,
    records_contain,
    records_hold,
)
from conformodal.pipeline.results.runs import read_metrics, read_trajectories, read_unfinished, write_metrics

from .console import console, print_where, report_line, report_strongly
from .failures import report_errors
from .outcome import describe_coverage, print_errors
from .sources import FollowOutside, MaxGap, TimeOffset, open_sequence, read_poses


@report_errors()
def evaluate(
    out: Annotated[Path, typer.Argument(help="Folder of results that run wrote.")],
    truth: Annotated[Path, typer.Option(help="True poses: a TUM trajectory, or a data set with poses.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout, if it is a data set.")] = Layout.AUTO,
    alignment: Annotated[
        Alignment, typer.Option("--align", help="Alignment of each trajectory before the comparison.")
    ] = Alignment.NONE,
    max_gap: MaxGap = MAX_GAP_S,
    time_offset: TimeOffset = 0.0,
    follow_outside: FollowOutside = False,
) -> None:
    """Compare results with true poses, interpolated by time. Writes OUT/evaluation/metrics.json."""
    with writing_in(out), lock_output(out / "evaluation", "evaluate"):
        recover(out)
        found = _read_results(out)
        true_poses = _read_truth(truth, layout, time_offset, follow_outside=follow_outside)
        rows, gaps = poses_at(true_poses, found.times.timestamps_s, max_gap)
        mine = np.flatnonzero(np.isfinite(rows).all(axis=1))
        if not mine.size:
            associate(found.times, true_poses, max_gap)  # says why
            raise OdometryError(f"{truth}: no pose of the results lies between true ones within {max_gap:g} s")
        matched = Trajectory(found.times.timestamps_s[mine], rows[mine, :3], rows[mine, 3:])
        moved = {name: align(t[mine], matched, alignment) for name, t in found.trajectories.items()}
        errors = {name: row | _motion_errors(moved[name], matched) for name, row in error_table(moved, matched).items()}
        doubt = ""
        if alignment in (Alignment.SE3, Alignment.SIM3) and moved:
            doubt = straightness(matched, next(iter(errors.values()))["rmse_m"])
        metrics = found.metrics
        sign = metrics.get("sign_reference_quat_wxyz")
        # regions lie in the world of the answer: there the truth is brought by what brings it nearest to the answer
        answer = next(iter(found.trajectories.values()), None)
        here = matched if alignment is Alignment.NONE or answer is None else align(matched, answer[mine], alignment)
        records = [found.records[i] for i in mine]
        sign = None if sign is None else np.array(sign, dtype=np.float64)
        inside, held = records_contain(records, here, sign), records_hold(records, here, sign)
        bounded = np.array([record_bounded(record) for record in records], dtype=np.bool_)
        result: dict[str, Any] = {
            "command": "evaluate",
            "results": result_digests(out),
            "provenance": provenance(),
            "configuration": {"results": metrics.get("configuration"), "truth": truth.name, "align": alignment},
            "seed": metrics.get("seed"),
            "unfinished": found.unfinished,
            "n_matched": len(mine),
            "largest_gap_s": float(gaps[mine].max()),
            "alignment_doubt": doubt or None,
            "n_answered": len(found.times),
            "errors": errors,
            "coverage": {
                "targets": dict(zip(TARGET_NAMES, inside.mean(axis=0).tolist(), strict=True)),
                "joint_coverage": float(held.mean()),
                "n_evaluated": len(mine),
                "abstained": float((~bounded).mean()),
                **bounded_coverage(held, bounded),
                "path_coverage": float(records_hold(records, here, sign, "path_places").mean())
                if all(record.get("path_places") is not None for record in records)
                else None,
                "note": "share of true poses in the stored intervals; whether alpha guarantees it depends on how these "
                "frames relate to the calibration frames",
            },
        }
        write_metrics(out / "evaluation", result)
    if found.unfinished:
        report_strongly("the run did not come to its end: what it had written until then is evaluated")
    have = noun_for(len(mine), "has", "have")
    answers, gap = counted(len(found.times), "pose"), gaps[mine].max()
    hint = clock_hint(found.times.timestamps_s, true_poses.timestamps_s) if 2 * len(mine) < len(found.times) else ""
    console.print(f"{len(mine)} of {answers} {have} a true one; the largest gap bridged is {gap:.3g} s{hint}")
    if doubt:
        report_strongly(doubt)
    moved_by = "" if alignment is Alignment.NONE else f", aligned by {alignment}"
    print_errors(errors, f"against {truth.name}{moved_by}")
    report_line(describe_coverage(result["coverage"]))
    print_where(out / "evaluation")


@dataclass(frozen=True, eq=False)
class Results:
    """Content of a folder of results: as many records as poses of each method."""

    metrics: dict[str, Any]  # of the run; empty where they are missing
    records: list[dict[str, Any]]  # one per frame
    trajectories: dict[str, Trajectory]  # by method, the answer first
    times: Trajectory  # of the frames; the poses are placeholders if there is no method
    unfinished: bool  # whether the run was killed


def _read_results(out: Path) -> Results:
    """Read results; of a run that was killed, what is whole: frames that all its files know."""
    killed = (out / REGIONS).is_file() and not (out / METRICS).exists()
    metrics = {} if killed else read_metrics(out)
    unfinished = not metrics or bool(metrics.get("unfinished"))
    records = read_region_records(out / REGIONS, torn=unfinished)
    if not unfinished:
        check_belongs(out, metrics)
        trajectories = read_trajectories(out)
        answer = next(iter(trajectories.values()))
        if any(len(t) != len(answer) for t in trajectories.values()) or len(records) != len(answer):
            raise OdometryError(f"{out}: trajectories and regions differ in length; was a run overwritten half-way?")
        other = [name for name, t in trajectories.items() if not np.array_equal(t.timestamps_s, answer.timestamps_s)]
        if other:
            raise OdometryError(f"{out}: the poses of {other[0]} have other times than the answer: of another run?")
        return Results(metrics, records, trajectories, answer, unfinished)
    if not records:
        raise OdometryError(f"{out}: the run was killed before it had answered a frame; run it again")
    return _common(metrics, records, read_unfinished(out))


def _common(metrics: dict[str, Any], records: list[dict[str, Any]], trajectories: dict[str, Trajectory]) -> Results:
    """The frames that all files know, by their times in microseconds, which is what files say."""
    stamps = [round(1e6 * r["timestamp_s"]) for r in records]
    known = {name: np.round(1e6 * t.timestamps_s).astype(np.int64) for name, t in trajectories.items()}
    both = sorted(set(stamps).intersection(*(set(times.tolist()) for times in known.values())))
    at = {stamp: i for i, stamp in enumerate(stamps)}
    kept = {name: t[np.flatnonzero(np.isin(known[name], both))] for name, t in trajectories.items()}
    n = len(both)
    nowhere = Trajectory(np.array(both) / 1e6, np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)))
    return Results(metrics, [records[at[s]] for s in both], kept, next(iter(kept.values()), nowhere), True)


def _motion_errors(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Recall; relative errors from pose to pose; and KITTI's drift where the path is long enough."""
    found: dict[str, Any] = {"recall": recall(estimate, truth)}
    if len(truth) > 1:
        metres, degrees = relative_errors(estimate, truth)
        found |= {"rpe_rmse_m": float(np.sqrt(np.mean(metres**2))), "rpe_rmse_deg": float(np.sqrt(np.mean(degrees**2)))}
    length = float(np.sum(np.linalg.norm(np.diff(truth.positions_xyz, axis=0), axis=1)))
    if length > KITTI_LENGTHS_M[0]:
        found |= dict(zip(("drift_percent", "drift_deg_per_m"), kitti_drift(estimate, truth), strict=True))
    return found


def _read_truth(path: Path, layout: Layout, offset_s: float, *, follow_outside: bool) -> Trajectory:
    """True poses from a TUM file or a data set."""
    if path.is_dir():
        poses = open_sequence(path, layout, require_poses=True, follow_outside=follow_outside).require_truth()
        return replace(poses, timestamps_s=poses.timestamps_s + offset_s)
    return read_poses(path, offset_s)
