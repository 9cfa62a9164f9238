"""``conformodal data``: what a data set holds, and the same in another layout."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.core.files import default_cache_dir
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io import DatasetError, Layout, Recording, check_recording
from conformodal.io.check import DatasetCheck
from conformodal.io.convert import convert_stream
from conformodal.io.diagnosis.axes import OPENCV, convert_poses, parse_axes, parse_world_axes
from conformodal.io.frame_table import METRES_PER_UNIT, NO_POSE
from conformodal.io.recording import as_camera, join_recordings
from conformodal.io.streams.frames import RecordingStream
from conformodal.localizer.overlap import Overlap, measure_overlap
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.pipeline.store import load_model, model_digest
from conformodal.quality.advice import quality_record
from conformodal.quality.examining import examine, median_depth

from .console import AsJson, Group, OptionError, Quiet, print_json, print_where, progress_bars, report_line
from .sources import (
    AllData,
    Cache,
    Camera,
    DataLayout,
    Focal,
    MaxGap,
    TimeOffset,
    cache_folder,
    lens_of,
    open_sequence,
    open_source,
    read_poses,
    report_notes,
)

app = typer.Typer(cls=Group, help="Check or convert a data set.", no_args_is_help=True, add_completion=False)


@app.callback()
def data() -> None:
    """Check or convert a data set."""


@app.command()
def check(
    folders: AllData,
    layout: DataLayout = Layout.AUTO,
    out: Annotated[Path | None, typer.Option(help="Folder for metrics.json, and a page if there are poses.")] = None,
    model: Annotated[Path | None, typer.Option(help="Saved model: report what it does not know, too.")] = None,
    cache: Cache = None,
    focal: Focal = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Print what a data set holds, what is wrong with it (exit code 1 if anything is), and what is missing."""
    with nullcontext() if out is None else lock_output(out, "data", apart=folders):
        if out is not None:  # refuse to begin where what draws is not installed
            from conformodal.report.figures import write_quality_page  # noqa: PLC0415 - it takes time to import
        parts = [open_sequence(path, layout, require_poses=False, focal=focal, notes=False) for path in folders]
        sequence = join_recordings(parts)
        trained = None if model is None else load_model(model)
        if trained is not None:
            trained.check_camera(sequence.camera)
        features = FeatureCache(default_cache_dir() if trained is None else cache_folder(cache))
        with progress_bars() as report:
            checked = check_recording(sequence, lambda done, total: report("images", done, total))
            quality = examine(sequence, trained, cache=features, progress=report)
        findings = _report_check(checked)
        overlaps = _report_overlaps(parts)
        record: dict[str, Any] = {
            "command": "data check",
            "provenance": provenance(),
            "configuration": {"data": " + ".join(path.name for path in folders), "format": str(layout)},
            "check": asdict(checked),
        }
        if model is not None:
            record["configuration"]["model"] = model_digest(model)
        if overlaps:
            record["overlaps"] = [asdict(overlap) for overlap in overlaps]
        useful = trained is not None or quality.poses is not None
        wrong = [finding for finding in checked.findings if finding.wrong]
        if not useful:
            report_line("good enough: not to train on, without poses", bold=True)
        else:
            record["quality"] = quality_record(quality)
            if told := [f"{one.what}: {one.first}" for one in wrong if one.what != NO_POSE]:  # train leaves these out
                record["quality"]["verdict"] = f"good enough: no, fix this first: {'; '.join(told)}"
            for line in record["quality"]["summary"]:
                report_line(line)
            report_line(record["quality"]["verdict"], bold=True)
            for number, line in enumerate(record["quality"]["advice"], start=1):
                report_line(f"  {number}. {line}")
        if out is not None:
            write_metrics(out, record)
            write_quality_page(out, quality if useful else None, record, findings)
            print_where(out)
    print_json(record)
    if wrong:
        raise typer.Exit(1)


@app.command()
def convert(
    source: Annotated[str, typer.Argument(help="A data set's folder, a video, or a ROS recording.")],
    out: Annotated[Path, typer.Option(help="Folder to write, new or empty.")],
    layout: DataLayout = Layout.AUTO,
    to: Annotated[str, typer.Option(help="Layout to write: tum.")] = "tum",
    poses: Annotated[str | None, typer.Option(help="TUM file, or a topic of a ROS recording; interpolated.")] = None,
    camera: Camera = None,
    max_gap: MaxGap = MAX_GAP_S,
    time_offset: TimeOffset = 0.0,
    topic: Annotated[str | None, typer.Option(help="Image topic of a ROS recording that has several.")] = None,
    axes: Annotated[str, typer.Option(help="Where x, y, z of the poses point, as the camera sees.")] = OPENCV,
    world_axes: Annotated[str, typer.Option(help="Positions' axes that are those of orientations: y,x,-z.")] = "x,y,z",
    world_to_camera: Annotated[bool, typer.Option("--world-to-camera", help="Poses are inverse.")] = False,
) -> None:
    """Convert a data set, a video or a ROS recording to a data set in TUM's layout, poses included."""
    if to != "tum":
        raise OptionError(f"--to must be tum, the only layout that is written, got {to!r}")
    parse_axes(axes), parse_world_axes(world_axes)  # refused before images are read
    stream = open_source(source, layout, topic=topic)
    if stream.live:
        raise DatasetError(f"{stream.name}: has no end; record a video and convert that")
    given, unit = (stream.sequence.poses, stream.sequence.unit) if isinstance(stream, RecordingStream) else (None, "m")
    truth = given if poses is None else read_poses(poses, time_offset, stream, max_gap)
    if given is not None and poses is None and unit != "m":
        how = f"write the metres of one unit into {METRES_PER_UNIT} in its folder"
        raise DatasetError(f"{stream.name}: has lengths in {unit}, and TUM's layout has them in metres; {how}")
    changed = (axes, world_axes, world_to_camera) != (OPENCV, "x,y,z", False)
    if changed and truth is None:
        raise OptionError(f"--axes, --world-axes and --world-to-camera are for poses, and {stream.name} has none")
    if truth is not None and changed:
        truth = convert_poses(truth, axes, world_axes, world_to_camera=world_to_camera)
    if stream.camera is not None and camera is not None:
        raise OptionError(f"--camera is for sources without calibration, and {stream.name} has {stream.camera}")
    lens = stream.camera or lens_of(stream, camera)
    gap_s, total = 0.0 if poses is None else max_gap, stream.n_frames or 0
    with progress_bars() as report:
        done = convert_stream(out, stream, lens, truth, lambda n: report("frames", n, max(total, n)), gap_s)
    report_line(f"{counted(done.n_frames, 'frame')} written, {done.n_posed} of them with poses")
    report_notes(done.notes)
    print_where(out)


def _report_check(checked: DatasetCheck) -> list[str]:
    """Print what the data hold and what is wrong with them; returns the latter, one line each."""
    recordings = f" in {checked.n_recordings} recordings" if checked.n_recordings > 1 else ""
    missing = checked.n_poses < checked.n_frames
    poses = f"{checked.n_poses} of {counted(checked.n_frames, 'frame')}" if missing else f"{checked.n_poses}"
    if checked.extent_m is not None:
        sides = " x ".join(f"{side:.2f}" for side in checked.extent_m)
        poses += f", all rigid motions; within {sides} {checked.unit}, path {checked.path_m:.2f} {checked.unit}"
    report_line(f"frames: {checked.n_frames}{recordings}, {checked.width}x{checked.height}")
    report_line(f"time: {checked.duration_s:.2f} s, usually {checked.rate_hz:.2f} frames per second")
    report_line(f"poses: {poses}")
    lines = [
        f"{'' if one.wrong else 'note: '}{one.count} x {one.what}: {'first ' if one.count > 1 else ''}{one.first}"
        for one in checked.findings
    ]
    if not any(one.wrong for one in checked.findings):
        report_line("nothing is wrong with it")
    for line in lines:
        report_line(line)
    return lines


def _report_overlaps(parts: list[Recording]) -> list[Overlap]:
    """How each data set after the first overlaps with the first."""
    first, overlaps = parts[0], []
    for part in parts[1:]:
        if first.poses is None or part.poses is None:
            report_line(f"{part.name}: whether it overlaps with {first.name} is known only where both have poses")
            continue
        new = part if part.camera == first.camera else as_camera(part, first.camera)
        overlaps.append(measure_overlap(first, new, median_depth(first)))
        report_line(overlaps[-1].describe(first.name, part.name), bold=overlaps[-1].frames_differ)
    return overlaps
