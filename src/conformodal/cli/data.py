"""``conformodal data``: what a data set is, and the same in another layout."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from conformodal.core.files import default_cache_dir
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.geometry import PinholeCamera
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io import DatasetError, Layout, Recording, check_recording
from conformodal.io.cameras import camera_beside
from conformodal.io.convert import WRITABLE, write_layout
from conformodal.io.joining import join_recordings
from conformodal.io.lenses import as_camera
from conformodal.io.reading import Note
from conformodal.io.streams.frames import FrameStream
from conformodal.io.streams.stored import RecordingStream
from conformodal.localizer.overlap import Overlap, measure_overlap
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results.folders import lock_output
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.results.runs import write_metrics
from conformodal.pipeline.store import load_model, model_digest
from conformodal.quality.advice import describe_quality, quality_record, record_next
from conformodal.quality.examining import RecordingQuality, examine

from .console import console, print_where, progress_bars, report_errors, report_line, report_strongly
from .options import OptionError
from .sources import Focal, FollowOutside, MaxGap, TimeOffset, cache_folder, open_sequence, open_source, read_poses

app = typer.Typer(help="Check or convert a data set.", no_args_is_help=True)
_FOUND = 1
PAGE, FIGURES = "report.html", "figures"


@app.callback()
def data() -> None:
    """Check or convert a data set."""


@app.command()
@report_errors
def check(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DATA...", help="Data sets; of several, also how they overlap.")
    ],
    layout: Annotated[Layout, typer.Option("--format", help="Layout of the data set.")] = Layout.AUTO,
    out: Annotated[Path | None, typer.Option(help="Folder for metrics.json, and a page if there are poses.")] = None,
    model: Annotated[
        Path | None, typer.Option(help="Saved model: also report sparsely covered and ambiguous places.")
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Cache folder, with --model; ~/.cache/conformodal by default.")
    ] = None,
    focal: Focal = None,
    follow_outside: FollowOutside = False,
) -> None:
    """Print what a data set holds, what is wrong with it (exit code 1 if anything is), and what is missing."""
    with nullcontext() if out is None else lock_output(out, "data", apart=folders):
        _check(folders, layout, out, model, cache, follow_outside, focal)


def _check(
    folders: list[Path],
    layout: Layout,
    out: Path | None,
    model: Path | None,
    cache: Path | None,
    follow_outside: bool,
    focal: str | None,
) -> None:
    if out is not None:
        import conformodal.report.quality  # noqa: F401, PLC0415 - refuse to begin where what draws is not installed
    open_one = partial(open_sequence, layout=layout, require_poses=False, follow_outside=follow_outside, focal=focal)
    parts = [open_one(its, notes=False) for its in folders]
    sequence = join_recordings(parts)
    known = None if model is None else load_model(model)
    if known is not None:
        known.check_camera(sequence.camera)
        cache = cache_folder(cache)
    with progress_bars() as report:
        found = check_recording(sequence, lambda done, total: report("images", done, total))
        quality = _quality(sequence, known, cache or default_cache_dir(), report)
    table = Table(show_header=False)
    recordings = f" in {found.n_recordings} recordings" if found.n_recordings > 1 else ""
    table.add_row("frames", f"{found.n_frames}{recordings}, {found.width}x{found.height}")
    table.add_row("time", f"{found.duration_s:.2f} s, usually {found.rate_hz:.2f} frames per second")
    if found.extent_m is None:
        some = f"for {found.n_poses} of {counted(found.n_frames, 'frame')}" if found.n_poses else "none"
        table.add_row("poses", some)
    else:
        sides = " x ".join(f"{side:.2f}" for side in found.extent_m)
        table.add_row("poses", f"{found.n_poses}, all rigid motions; within {sides} m, path {found.path_m:.2f} m")
    console.print(table)
    findings = [
        f"{'' if its.wrong else 'note: '}{its.count} x {its.what}: {'first ' if its.count > 1 else ''}{its.first}"
        for its in found.findings
    ]
    for line in findings:
        report_line(line)
    wrong = any(finding.wrong for finding in found.findings)
    if not wrong:
        console.print("nothing is wrong with it")
    overlaps = _report_overlaps(parts)
    if quality is not None:
        _report_quality(quality)
    if out is not None:
        configuration: dict[str, Any] = {"data": " + ".join(its.name for its in folders), "format": str(layout)}
        if model is not None:
            configuration |= {"model": model_digest(model)}
        record: dict[str, Any] = {"command": "data check", "provenance": provenance(), "configuration": configuration}
        record |= {"check": asdict(found)} | ({"overlaps": [asdict(its) for its in overlaps]} if overlaps else {})
        _write_findings(out, quality, findings, record)
        print_where(out)
    if wrong:
        raise typer.Exit(_FOUND)


@app.command()
@report_errors
def convert(
    source: Annotated[str, typer.Argument(help="A data set's folder, a video, or a ROS recording.")],
    out: Annotated[Path, typer.Option(help="Folder to write, new or empty.")],
    to: Annotated[Layout, typer.Option(help=f"Layout to write: {', '.join(WRITABLE)}.")] = Layout.IMAGES,
    layout: Annotated[Layout, typer.Option("--format", help="Layout of a folder.")] = Layout.AUTO,
    poses: Annotated[
        str | None,
        typer.Option(help="TUM file of camera poses, or a topic of poses in a ROS recording, interpolated by time."),
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Folder with camera-intrinsics.txt, for sources without calibration.")
    ] = None,
    max_gap: MaxGap = MAX_GAP_S,
    time_offset: TimeOffset = 0.0,
    topic: Annotated[str | None, typer.Option(help="Image topic of a ROS recording that has several.")] = None,
    follow_outside: FollowOutside = False,
) -> None:
    """Convert a data set, a video or a ROS recording to a data set in another layout, poses included."""
    stream = open_source(source, layout, topic=topic, follow_outside=follow_outside)
    if stream.live:
        raise DatasetError(f"{stream.name}: has no end; record a video and convert that")
    own = stream.sequence.poses if isinstance(stream, RecordingStream) else None
    truth = own if poses is None else read_poses(poses, time_offset, stream, max_gap)
    if stream.camera is not None and camera is not None:
        raise OptionError(f"--camera is for sources without calibration, and {stream.name} has {stream.camera}")
    lens = stream.camera or _camera(camera, stream)
    gap_s, total = 0.0 if poses is None else max_gap, stream.n_frames or 0
    with progress_bars() as report:

        def progress(number: int) -> None:
            report("frames", number, max(total, number))

        done = write_layout(out, to, stream, lens, truth, progress, max_gap_s=gap_s)
    how_many = (
        "with" if done.n_posed == done.n_frames else f"{done.n_posed} of them with" if done.n_posed else "without"
    )
    back = f", {done.n_without_time} whose time goes back" if done.n_without_time else ""
    written = f"{counted(done.n_frames, 'frame')} written as {to}, {how_many} poses"
    report_line(f"{written}; left out: {done.n_unreadable} unreadable{back}")
    for note in done.notes:
        report_line(f"note: {note}")
    print_where(out)


def _camera(folder: Path | None, stream: FrameStream) -> PinholeCamera:
    if folder is None:
        raise DatasetError("the source has no calibration; name a folder with camera-intrinsics.txt by --camera")
    first = next((frame.image for frame in stream if frame.image is not None), None)
    if first is None:
        raise DatasetError(f"{stream.name}: no image can be read, so the size of the images is not known")
    height, width, _ = first.shape
    notes: list[Note] = []
    camera = camera_beside(folder, (width, height), None, notes)
    for what, where in notes:
        report_line(f"{what}: {where}")
    return camera


def _quality(
    sequence: Recording, model: PoseModel | None, cache: Path, report: StageProgress
) -> RecordingQuality | None:
    """Examine a recording; None where there is nothing to go by, neither poses nor a model."""
    if model is not None:
        return examine(sequence, model, cache=FeatureCache(cache), progress=report)
    found = examine(sequence)
    return None if found.poses is None else found


def _report_overlaps(parts: list[Recording]) -> list[Overlap]:
    """How each data set after the first overlaps with the first."""
    known, found = parts[0], []
    for its in parts[1:]:
        if known.poses is None or its.poses is None:
            report_line(f"{its.name}: whether it overlaps with {known.name} is known only where both have poses")
            continue
        depth_m = float("nan") if known.truth is None else measure_depths(known, np.arange(len(known)))[0]
        new = its if its.camera == known.camera else as_camera(its, known.camera)
        found.append(measure_overlap(known, new, depth_m))
        (report_strongly if found[-1].frames_differ else report_line)(found[-1].describe(known.name, its.name))
    return found


def _report_quality(found: RecordingQuality) -> None:
    """The findings, and what to record or train on next."""
    for line in describe_quality(found):
        report_line(line)
    advice = record_next(found)
    if advice:
        report_strongly("what to record or train on next, the most valuable first:")
    for number, line in enumerate(advice, start=1):
        report_line(f"  {number}. {line}")


def _write_findings(out: Path, found: RecordingQuality | None, findings: list[str], record: dict[str, Any]) -> None:
    """Write ``metrics.json``, and then the page, or none where there is nothing to show."""
    from conformodal.report.quality import PLAN, write_quality_page  # noqa: PLC0415 - what draws takes time to import

    if found is None:
        write_metrics(out, record)
        (out / PAGE).unlink(missing_ok=True)  # of an earlier check
        (out / FIGURES / PLAN).unlink(missing_ok=True)
        return
    whole = {**record, "quality": quality_record(found)}
    write_metrics(out, whole)
    write_quality_page(out, found, whole, findings)
