"""``conformodal evaluate``: results against a truth."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.core.arrays import FloatArray
from conformodal.core.files import write_whole
from conformodal.core.words import counted, noun_for
from conformodal.geometry import TARGET_NAMES, Alignment, Trajectory, align, poses_at, relative_errors
from conformodal.geometry.metrics import MAX_GAP_S, orientation_errors_deg, position_errors_m, straightness
from conformodal.io import Layout
from conformodal.io.diagnosis.clocks import clock_hint, describe_time_offset
from conformodal.io.diagnosis.trajectories import doubt_truth
from conformodal.io.folders import writing_in
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.evaluate import bounded_coverage, coverage_by_room, error_table
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import (
    intervals_hold,
    lock_output,
    read_run,
    record_bounded,
    records_hold,
    write_metrics,
)

from .answering import describe_coverage, print_errors
from .console import AsJson, Quiet, print_json, print_where, report_line
from .sources import MaxGap, TimeOffset, open_sequence, read_poses

_NOTE = (
    "share of true poses in the stored intervals; whether alpha guarantees it depends on how these frames relate to "
    "the calibration frames"
)


def evaluate(
    out: Annotated[Path, typer.Argument(help="Folder of results that run wrote.")],
    truth: Annotated[Path, typer.Option(help="True poses: a TUM trajectory, or a data set with poses.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout, if it is a data set.")] = Layout.AUTO,
    alignment: Annotated[Alignment, typer.Option("--align", help="Of each path with the truth.")] = Alignment.NONE,
    max_gap: MaxGap = MAX_GAP_S,
    time_offset: TimeOffset = 0.0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Compare results with true poses: errors of every path and frame, and coverage.

    Poses are interpolated by time. Writes OUT/evaluation, or OUT/evaluation-ALIGNMENT.
    """
    folder = out / ("evaluation" if alignment is Alignment.NONE else f"evaluation-{alignment}")
    with writing_in(out), lock_output(folder, "evaluate"):
        result = read_run(out)
        unit = (result.metrics.get("configuration") or {}).get("unit", "m")
        if truth.is_dir():
            sequence = open_sequence(truth, layout, require_poses=True)
            if alignment is not Alignment.SIM3 and sequence.unit != unit:
                what = f"has lengths in {sequence.unit}, and the results in {unit}; --align sim3 scales them"
                raise OdometryError(f"{truth}: {what}")
            unit, true_poses = sequence.unit, sequence.require_truth()
            true_poses = replace(true_poses, timestamps_s=true_poses.timestamps_s + time_offset)
        else:
            unit, true_poses = "m" if alignment is Alignment.SIM3 else unit, read_poses(truth, time_offset)
        times = result.answer.timestamps_s
        rows, gaps = poses_at(true_poses, times, max_gap)
        posed = np.flatnonzero(np.isfinite(rows).all(axis=1))
        if not posed.size:
            spans = [f"{t.min():.3f} to {t.max():.3f} s" for t in (times, true_poses.timestamps_s)]
            raise OdometryError(
                f"{truth}: no pose of the results, from {spans[0]}, lies between true ones within {max_gap:g} s, from "
                f"{spans[1]}{clock_hint(times, true_poses.timestamps_s)}"
            )
        matched = Trajectory(times[posed], rows[posed, :3], rows[posed, 3:])
        aligned = {name: align(path[posed], matched, alignment) for name, path in result.trajectories.items()}
        errors = {
            name: row | _motion_errors(aligned[name], matched) for name, row in error_table(aligned, matched).items()
        }
        doubts = doubt_truth(next(iter(aligned.values())), matched, unit)
        clock = describe_time_offset(result.answer, true_poses)
        reasons = [f"{truth.name}: {reason}" for reason in (*doubts.reasons, clock) if reason]
        if doubts.positions_only:
            # relative errors need orientations
            errors = {name: {key: row[key] for key in ("rmse_m", "median_m")} for name, row in errors.items()}
        elif alignment in (Alignment.SE3, Alignment.SIM3):
            reasons += filter(None, [straightness(matched, next(iter(errors.values()))["rmse_m"], unit)])
        # regions lie in the world of the answer: there the truth is brought by what brings it nearest to the answer
        here = matched if alignment is Alignment.NONE else align(matched, result.answer[posed], alignment)
        coverage = _coverage(
            [result.records[i] for i in posed], here, result.sign_reference, positions_only=doubts.positions_only
        )
        evaluation = {
            "command": "evaluate",
            "results": result.metrics.get("results"),
            "provenance": provenance(),
            "configuration": {"results": result.metrics.get("configuration"), "truth": truth.name, "align": alignment},
            "seed": result.metrics.get("seed"),
            "n_matched": len(posed),
            "largest_gap_s": float(gaps[posed].max()),
            "truth_doubts": reasons,
            "n_answered": len(times),
            "errors": errors,
            "coverage": coverage,
        }
        write_metrics(folder, evaluation)
        names = [result.records[i]["frame"] for i in posed]
        _write_frame_errors(folder, names, aligned, matched, unit, positions_only=doubts.positions_only)
    hint = clock_hint(times, true_poses.timestamps_s) if 2 * len(posed) < len(times) else ""
    report_line(
        f"{len(posed)} of {counted(len(times), 'pose')} {noun_for(len(posed), 'has', 'have')} a true one; the largest "
        f"gap bridged is {gaps[posed].max():.3g} s{hint}"
    )
    for reason in reasons:
        report_line(reason, bold=True)
    print_errors(errors, f"against {truth.name}" + ("" if alignment == "none" else f", aligned by {alignment}"), unit)
    report_line(describe_coverage(coverage))
    print_where(folder)
    print_json(evaluation)


def _write_frame_errors(
    folder: Path, names: list[str], paths: dict[str, Trajectory], truth: Trajectory, unit: str, *, positions_only: bool
) -> None:
    """Write ``errors.csv``, one row per frame, and ``errors.svg`` if the extra ``figures`` is installed."""
    measures = {unit: position_errors_m} | ({} if positions_only else {"deg": orientation_errors_deg})
    errors = {name: np.column_stack([of(path, truth) for of in measures.values()]) for name, path in paths.items()}
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["frame", "timestamp_s", *(f"{name}_{measure}" for name in paths for measure in measures)])
    rows.writerows(zip(names, truth.timestamps_s, *np.hstack(list(errors.values())).T, strict=True))
    write_whole(folder / "errors.csv", text.getvalue())
    if find_spec("matplotlib"):
        from conformodal.report.figures import errors_figure  # noqa: PLC0415 - an extra

        write_whole(folder / "errors.svg", errors_figure(truth.timestamps_s, errors, unit))


def _coverage(
    records: list[dict[str, Any]], truth: Trajectory, sign_reference: FloatArray, *, positions_only: bool
) -> dict[str, Any]:
    """The share of true poses in the stored regions; of true positions where orientations are not known."""
    inside = intervals_hold(records, truth, sign_reference).mean(axis=0).tolist()
    if positions_only:
        targets = dict(zip(TARGET_NAMES[:3], inside[:3], strict=True))
        return {"targets": targets, "joint_coverage": None, "n_evaluated": len(records), "note": _NOTE}
    held = records_hold(records, truth, sign_reference)
    bounded = np.array([record_bounded(record) for record in records], dtype=np.bool_)
    path_coverage = None
    if all(record["path_places"] is not None for record in records):
        path_coverage = float(records_hold(records, truth, sign_reference, "path_places").mean())
    return {
        "targets": dict(zip(TARGET_NAMES, inside, strict=True)),
        "joint_coverage": float(held.mean()),
        "n_evaluated": len(records),
        "abstained": float((~bounded).mean()),
        **bounded_coverage(held, bounded),
        "by_room": coverage_by_room(held, bounded, np.array([record.get("room", 0) for record in records])),
        "path_coverage": path_coverage,
        "note": _NOTE,
    }


def _motion_errors(estimate: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Relative errors from pose to pose, as evo has them."""
    if len(truth) < 2:
        return {}
    metres, degrees = relative_errors(estimate, truth)
    return {"rpe_rmse_m": float(np.sqrt(np.mean(metres**2))), "rpe_rmse_deg": float(np.sqrt(np.mean(degrees**2)))}
