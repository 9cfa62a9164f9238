"""``conformodal run``: a model on a source; trajectory, regions, metrics and a page."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import typer

from conformodal.core.words import counted
from conformodal.geometry import Trajectory
from conformodal.io import Layout, Recording
from conformodal.io.joining import join_streams
from conformodal.io.lenses import as_camera, describe_change
from conformodal.io.streams.bag import BagStream
from conformodal.io.streams.frames import Frame, FrameStream, SourceError
from conformodal.io.streams.prefetch import Pace, prefetch
from conformodal.io.streams.stored import RecordingStream
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.paper import odometry_of
from conformodal.pipeline.results import ResultsWriter, lock_output, write_metrics, write_region_parquet
from conformodal.pipeline.store import load_model, model_digest
from conformodal.pipeline.stream import StreamRunner
from conformodal.report.page import ReportContent, write_page
from conformodal.report.viewer import Thumbnails, make_viewer

from .console import StageReport, print_where, progress_bars, report_line
from .failures import BROKE_OFF, OptionError, report_errors, stop_code, stopping
from .outcome import GroundTruth, Part, describe_outcome, part_frames, report_outcome, run_metrics
from .sources import DataLayout, FollowOutside, SavedModel, open_source

_INTERRUPTED = "interrupted"
RERUN_SUFFIX, ROS_SUFFIX = ".rrd", ".mcap"


@report_errors()
def run(
    model: SavedModel,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="Frames: a data set's folder, a video, a ROS recording (.bag, .mcap), or camera:0. Several run one "
            "after the other.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    layout: DataLayout = Layout.AUTO,
    part: Annotated[Part, typer.Option(help="Frames to answer: all, or a part of the model's own data set.")] = (
        Part.ALL
    ),
    alpha: Annotated[float | None, typer.Option(help="Another miscoverage rate than the model was saved with.")] = None,
    novelty_level: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Another level than the model was saved with: an image whose p-value of showing a known place is at "
            "most this gets an unbounded region.",
        ),
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Image topic of a ROS recording that has several.")] = None,
    pace: Annotated[
        Pace, typer.Option(help="fast: as fast as it can; camera: by the timestamps, losing frames that come too soon.")
    ] = Pace.FAST,
    limit: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Show it live in Rerun (extra 'view').")] = False,
    follow_outside: FollowOutside = False,
    save: Annotated[
        Path | None,
        typer.Option(help="Record: a file .rrd for Rerun (extra 'view'), or .mcap with ROS 2 messages (extra 'ros')."),
    ] = None,
    save_images: Annotated[bool, typer.Option("--save-images", help="Keep the images in the .mcap too.")] = False,
) -> None:
    """Compute regions and the trajectory of sources with a saved model, frame by frame.

    Ctrl-C stops it and keeps the results.
    """
    _check_recording(save, sources, images=save_images)
    with lock_output(out, "run", apart=[model, *map(Path, sources)]):
        loaded = load_model(model)
        if alpha is not None:
            loaded.recalibrate(alpha)
        if novelty_level is not None:
            if novelty_level and loaded.novelty is None:
                raise OptionError(f"--novelty-level: the model has no test for unknown places, got {novelty_level:g}")
            loaded.set_novelty_level(novelty_level)
        assumed = loaded.camera if part is Part.ALL else None  # of sources without calibration, which have no parts
        open_one = partial(open_source, topic=topic, as_trained=part is not Part.ALL, follow_outside=follow_outside)
        opened = [open_one(source, layout, camera=assumed) for source in sources]
        stream = join_streams([_as_trained(loaded, its, bring=part is Part.ALL) for its in opened])
        if isinstance(stream, RecordingStream):
            stream = RecordingStream(stream.sequence, part_frames(loaded, stream.sequence, part))
        elif part is not Part.ALL:
            raise OdometryError(f"{stream.name}: only a data set has a {part} part; run on all of it")
        how = _StreamOptions(part, pace, limit, model_digest(model))
        with frame_sinks(stream.name, loaded.alpha, view=view, save=save, images=save_images) as watching:
            metrics, unbounded = _stream_through(loaded, stream, out, how, watching)
    report_outcome(stream.name, metrics, unbounded=unbounded)
    print_where(out)
    if metrics["stopped"] == _INTERRUPTED:
        raise typer.Exit(stop_code([metrics["signal"]]))
    if metrics["stopped"]:
        raise typer.Exit(BROKE_OFF)


def _check_recording(save: Path | None, sources: list[str], *, images: bool) -> None:
    """Refuse a recording that would replace another kind of file or its own source, and images that no file is for."""
    suffix = "" if save is None else save.suffix.lower()
    if save is not None and (save.is_dir() or suffix not in (RERUN_SUFFIX, ROS_SUFFIX)):
        raise OptionError(f"--save must name a file {RERUN_SUFFIX} or {ROS_SUFFIX}, got {str(save)!r}")
    if save is not None and save.absolute() in [Path(source).absolute() for source in sources]:
        raise OptionError(f"--save would write over the source, {save}; name another file")
    if images and suffix != ROS_SUFFIX:
        raise OptionError(f"--save-images needs --save FILE{ROS_SUFFIX}, got {save or 'no --save'}")


def _as_trained(model: PoseModel, stream: FrameStream, *, bring: bool) -> FrameStream:
    """Images of another camera as the model's camera would have seen them, or an error if they are not to be."""
    camera = stream.camera
    if camera is None:
        return stream
    try:
        model.check_camera(camera)
        return stream
    except OdometryError as exc:
        if not bring:
            raise
        change = describe_change(camera, model.camera)
        report_line(f"{exc}: its images are brought to the model's camera, those of {change}")
    if isinstance(stream, RecordingStream):
        return replace(stream, sequence=as_camera(stream.sequence, model.camera))
    return replace(stream, camera=model.camera) if isinstance(stream, BagStream) else stream


class FrameSink(Protocol):
    """Receives every frame with its estimate."""

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Take a frame; `truth` is a trajectory of one, or None."""
        ...

    def close(self) -> None:
        """Finish writing."""
        ...


@contextmanager
def frame_sinks(
    name: str, alpha: object, *, view: bool, save: Path | None, images: bool
) -> Iterator[tuple[FrameSink, ...]]:
    """The views and recordings that the options of a run ask for; all are closed at the end."""
    ros = save is not None and save.suffix.lower() == ROS_SUFFIX
    rerun = None if ros else save
    found: list[FrameSink] = []
    with ExitStack() as opened:
        if save is not None and ros:
            from conformodal.ros.bag import BagWriter  # noqa: PLC0415 - an extra

            found.append(BagWriter(save, images=images))
            opened.callback(found[-1].close)
        if view or rerun is not None:
            from conformodal.report.live import LiveView  # noqa: PLC0415 - an extra

            found.append(LiveView(name, alpha, spawn=view, save=rerun))
            opened.callback(found[-1].close)
        yield tuple(found)


@dataclass(frozen=True)
class _StreamOptions:
    """Options of :func:`run`, and the digest of the model."""

    part: Part = Part.ALL
    pace: Pace = Pace.FAST
    limit: int | None = None
    digest: str | None = None


@dataclass(eq=False)
class _Shown:
    """What is shown of a stream: live views while it runs, pictures for the page afterwards."""

    watching: tuple[FrameSink, ...]
    pictures: Thumbnails = field(default_factory=Thumbnails)
    unbounded: bool = False

    def take(self, frame: Frame, estimate: Estimate, truth: Trajectory | None) -> None:
        if estimate.region is not None and frame.image is not None:
            self.pictures.add(frame.name, frame.image)
            known = estimate.evidence is not EvidenceType.UNKNOWN
            self.unbounded |= known and bool(estimate.region.unbounded.any())
        for watcher in self.watching:
            watcher.log(frame, estimate, truth)


def _stream_through(
    model: PoseModel, stream: FrameStream, out: Path, how: _StreamOptions, watching: tuple[FrameSink, ...]
) -> tuple[dict[str, Any], bool]:
    """Run a model on a stream and write everything.

    Returns the metrics, and whether the region of an image that shows a known place is unbounded in some target.
    """
    sequence: Recording | None = stream.sequence if isinstance(stream, RecordingStream) else None
    shown = _Shown(watching)
    lossy = stream.live or how.pace is Pace.CAMERA
    odometry = odometry_of(model)
    started = time.perf_counter()
    # a signal stops the stream; what follows is brought to its end, so that results are kept
    with stopping(gently=True) as stop, ResultsWriter(out, answer=odometry.answer) as writer:
        truth, posed = (None, None) if sequence is None else (sequence.poses, sequence.posed)
        with progress_bars(out) as report, StreamRunner(odometry, writer, truth=truth, posed=posed) as runner:
            stopped, limited = _push_all(runner, stream, shown, how, stop, report)
            runner.finish()
        seconds = time.perf_counter() - started
        if not runner.n_answered:
            first = next(iter(runner.problems.values()), "it holds no frame")
            raise OdometryError(f"{stream.name}: no frame could be answered: {stopped or first}")
        if runner.truth is not None:
            writer.truth(runner.truth)
        writer.close()
        counts = {**_counts(runner, writer), "stopped": stopped, "seconds": round(seconds, 2), "model": how.digest}
        counts |= {"signal": stop[0]} if stopped == _INTERRUPTED else {}
        whole = not (stopped or limited or lossy or runner.windowed)
        metrics = _write_results(model, runner, writer, shown, how.part, counts, stream.name, whole=whole)
    return metrics, shown.unbounded


def _push_all(
    runner: StreamRunner,
    stream: FrameStream,
    shown: _Shown,
    how: _StreamOptions,
    stop: list[int],
    report: StageReport,
) -> tuple[str, bool]:
    """Why the stream was stopped, if it was, and whether the limit ended it."""
    try:
        with closing(prefetch(stream, pace=how.pace)) as frames:
            for number, frame in enumerate(frames, start=1):
                estimate = runner.push(frame)
                if estimate is not None:
                    shown.take(frame, estimate, runner.true_pose(frame))
                    report("frames", number, stream.n_frames or 0, state_of(estimate))
                if stop or number == how.limit:
                    return _INTERRUPTED if stop else "", number == how.limit
    except SourceError as exc:
        return str(exc), False
    return "", False


def state_of(estimate: Estimate) -> str:
    """The outcome of a frame, in a few words."""
    if estimate.region is None:
        return f"no answer: {estimate.problem}"
    if estimate.evidence is EvidenceType.UNKNOWN:
        motion = estimate.relative_motion
        lost = "" if motion is None or motion.reliable else f", {motion.status}"
        return f"unknown place (p = {estimate.known_p:.2g}){lost}"
    places = counted(int((estimate.path_region or estimate.region).n_places[0]), "place")
    return f"{'reliable' if estimate.reliable else estimate.problem}, {places}"


def _write_results(
    model: PoseModel,
    runner: StreamRunner,
    writer: ResultsWriter,
    shown: _Shown,
    part: Part,
    counts: dict[str, Any],
    name: str,
    *,
    whole: bool,
) -> dict[str, Any]:
    """Write metrics, Parquet and the page; returns the metrics."""
    known = None
    if runner.truth is not None:
        known = GroundTruth(runner.truth, runner.statistics, np.array(runner.known), runner.path_coverage)
    trajectories = runner.trajectories
    metrics = run_metrics(model, part, trajectories, known, counts, whole=whole)
    write_metrics(writer.folder, metrics)
    if find_spec("pyarrow"):  # an extra
        write_region_parquet(writer.folder, writer.records)
    viewer = make_viewer(writer.records, trajectories, runner.truth, shown.pictures.jpegs, model.rules.level)
    page = ReportContent(f"conformodal: {name}", describe_outcome(name, metrics), metrics, viewer=viewer)
    write_page(writer.folder / "report.html", page)
    return metrics


def _counts(runner: StreamRunner, writer: ResultsWriter) -> dict[str, Any]:
    return {
        "n_answered": runner.n_answered,
        "results": writer.digests,
        "n_unreliable": runner.n_unreliable,
        "n_localized": runner.n_localized,
        "n_unknown": runner.n_unknown,
        "n_without_image": runner.n_problems,
        "problems": runner.problems,
        "motion": dict(sorted(runner.motion.items())),
    }
