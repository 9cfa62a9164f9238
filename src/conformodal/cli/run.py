"""``conformodal run``: a model on a source; trajectory, regions, metrics and a page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from conformodal.io import Layout
from conformodal.io.cameras import describe_change
from conformodal.io.recording import as_camera
from conformodal.io.streams.bag import BagStream
from conformodal.io.streams.frames import FrameStream, RecordingStream, join_streams
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.store import load_model, model_digest

from .answering import (
    INTERRUPTED,
    FrameSink,
    Part,
    answer_stream,
    describe_outcome,
    metrics_of,
    part_frames,
    report_outcome,
    write_answers,
)
from .console import (
    BROKE_OFF,
    AsJson,
    OptionError,
    Quiet,
    Verbose,
    print_json,
    print_where,
    progress_bars,
    report_line,
    stop_code,
    stopping,
)
from .sources import DataLayout, SavedModel, open_source

RERUN_SUFFIX, ROS_SUFFIX = ".rrd", ".mcap"
_SHOW = "Show and record"


def run(
    model: SavedModel,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="Frames: a data set's folder, a video, a ROS recording (.bag, .mcap), or camera:0. Several data "
            "sets run one after the other.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    layout: DataLayout = Layout.AUTO,
    part: Annotated[Part, typer.Option(help="Frames to answer: all, or the test part of the model's own data set.")] = (
        Part.ALL
    ),
    alpha: Annotated[float | None, typer.Option(help="Another miscoverage rate than the model was saved with.")] = None,
    topic: Annotated[str | None, typer.Option(help="Image topic of a ROS recording that has several.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show it live in Rerun (extra 'view').", rich_help_panel=_SHOW)
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            help="Record: a file .rrd for Rerun (extra 'view'), or .mcap with ROS 2 messages (extra 'ros').",
            rich_help_panel=_SHOW,
        ),
    ] = None,
    save_images: Annotated[
        bool, typer.Option("--save-images", help="Keep the images in the .mcap too.", rich_help_panel=_SHOW)
    ] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Compute regions and the trajectory of sources with a saved model, frame by frame.

    Ctrl-C stops it and keeps the results.
    """
    _check_recording(save, sources, images=save_images)
    with lock_output(out, "run", apart=[model, *map(Path, sources)]):
        loaded = load_model(model)
        if alpha is not None:
            loaded.recalibrate(alpha)
        whole = part is Part.ALL
        lens = loaded.camera if whole else None  # sources without calibration have no parts
        opened = [open_source(one, layout, topic=topic, as_trained=not whole, camera=lens) for one in sources]
        stream = join_streams([_as_trained(loaded, source, convert=whole) for source in opened])
        if isinstance(stream, RecordingStream):
            stream = RecordingStream(stream.sequence, part_frames(loaded, stream.sequence, part))
        elif not whole:
            raise OdometryError(f"{stream.name}: only a data set has a {part} part; run on all of it")
        # a signal stops the stream; what follows is brought to its end, so that results are kept
        with (
            stopping(gently=True) as signals,
            frame_sinks(stream.name, loaded.alpha, view=view, save=save, images=save_images) as sinks,
            progress_bars(out) as report,
        ):
            answers = answer_stream(loaded, stream, out, report, part=part, limit=limit, sinks=sinks, signals=signals)
            metrics = {**metrics_of(answers), "model": model_digest(model)}
            write_answers(answers, metrics, f"conformodal: {stream.name}", describe_outcome(stream.name, metrics))
    report_outcome(stream.name, metrics)
    print_where(out)
    print_json(metrics)
    if answers.stopped:
        raise typer.Exit(stop_code(signals) if answers.stopped == INTERRUPTED else BROKE_OFF)


def _check_recording(save: Path | None, sources: list[str], *, images: bool) -> None:
    """Refuse a recording that would replace another kind of file or its own source, and images that no file is for."""
    suffix = "" if save is None else save.suffix.lower()
    if save is not None and (save.is_dir() or suffix not in (RERUN_SUFFIX, ROS_SUFFIX)):
        raise OptionError(f"--save must name a file {RERUN_SUFFIX} or {ROS_SUFFIX}, got {str(save)!r}")
    if save is not None and save.absolute() in [Path(source).absolute() for source in sources]:
        raise OptionError(f"--save would write over the source, {save}; name another file")
    if images and suffix != ROS_SUFFIX:
        raise OptionError(f"--save-images needs --save FILE{ROS_SUFFIX}, got {save or 'no --save'}")


def _as_trained(model: PoseModel, stream: FrameStream, *, convert: bool) -> FrameStream:
    """Images of another camera as the model's camera would have seen them, or an error if they are not to be."""
    if stream.camera is None:
        return stream
    try:
        model.check_camera(stream.camera)
    except OdometryError as exc:
        if not convert:
            raise
        change = describe_change(stream.camera, model.camera)
        report_line(f"{exc}: its images are brought to the model's camera, those of {change}")
        if isinstance(stream, RecordingStream):
            return replace(stream, sequence=as_camera(stream.sequence, model.camera))
        if isinstance(stream, BagStream):
            return replace(stream, camera=model.camera)
    return stream


@contextmanager
def frame_sinks(name: str, alpha: object, *, view: bool, save: Path | None, images: bool) -> Iterator[list[FrameSink]]:
    """The views and recordings that the options of a run ask for; all are closed at the end."""
    ros = save if save is not None and save.suffix.lower() == ROS_SUFFIX else None
    rerun = None if ros else save
    sinks: list[FrameSink] = []
    with ExitStack() as stack:
        if ros is not None:
            from conformodal.ros.bag import BagWriter  # noqa: PLC0415 - an extra

            writer = BagWriter(ros, images=images)
            stack.callback(writer.close)
            sinks.append(writer.log)
        if view or rerun is not None:
            from conformodal.report.live import LiveView  # noqa: PLC0415 - an extra

            live = LiveView(name, alpha, spawn=view, save=rerun)
            stack.callback(live.close)
            sinks.append(live.log)
        yield sinks
