"""``conformodal run``: a model on a source; trajectory, regions, metrics and a page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from conformodal.features.local import extract_local_features
from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import view_as
from conformodal.io import Layout
from conformodal.io.cameras import INTRINSICS, describe_change
from conformodal.io.decoding import grey_image
from conformodal.io.recording import as_camera
from conformodal.io.streams.bag import is_bag
from conformodal.io.streams.frames import ConvertedStream, FrameStream, RecordingStream, join_streams
from conformodal.localizer.evidence import FrameEvidence
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.store import load_model, model_digest

from .answering import (
    INTERRUPTED,
    FrameSink,
    Part,
    StopWhen,
    answer_stream,
    describe_outcome,
    metrics_of,
    part_frames,
    report_outcome,
    write_answers,
)
from .console import (
    BROKE_OFF,
    OUTPUT_PANEL,
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
from .sources import DATA_PANEL, Camera, DataLayout, SavedModel, lens_of, open_source

RERUN_SUFFIX, ROS_SUFFIX = ".rrd", ".mcap"
_data, _show = (partial(typer.Option, rich_help_panel=panel) for panel in (DATA_PANEL, "Show and record"))
# for --focal auto: images, frames from one to the next, and focal lengths as shares of the longer side
_FRAMES, _APART, _FOCALS = 8, 30, 0.35 * 1.12 ** np.arange(15)


def run(
    model: SavedModel,
    sources: Annotated[list[str], typer.Argument(metavar="SOURCE...", help="Data, video, .bag, .mcap, or camera:0.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.", rich_help_panel=OUTPUT_PANEL)],
    layout: DataLayout = Layout.AUTO,
    part: Annotated[Part, _data(help="test: the test part of the model's own data set.")] = Part.ALL,
    camera: Camera = None,
    focal: Annotated[str | None, _data(metavar="PX|auto", help="Of a video or a device; auto: fitted.")] = None,
    topic: Annotated[str | None, _data(help="Image topic of a ROS recording that has several.")] = None,
    limit: Annotated[int | None, _data(min=1, help="Stop after so many frames.")] = None,
    alpha: Annotated[float | None, typer.Option(help="Another miscoverage rate than the model was saved with.")] = None,
    view: Annotated[bool, _show("--view", help="Show it live in Rerun (extra 'view').")] = False,
    save: Annotated[
        Path | None, _show(help="Record: .rrd of Rerun (extra 'view'), .mcap of ROS 2 (extra 'ros').")
    ] = None,
    save_images: Annotated[bool, _show("--save-images", help="Keep the images in the .mcap too.")] = False,
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
        lens = loaded.camera if whole and not (camera or focal) else None  # sources without calibration have no parts
        folders = [one for one in sources if Path(one).is_dir() and not is_bag(Path(one))]
        if folders and (camera or focal):
            how = f"write {INTRINSICS} into it, or leave the option out: then the model's camera is assumed"
            raise OptionError(f"--camera and --focal are for videos and devices, and {folders[0]} is a folder; {how}")
        opened = [open_source(one, layout, topic=topic, as_trained=not whole, camera=lens) for one in sources]
        if camera or focal:
            opened = [_calibrated(loaded, source, camera, focal) for source in opened]
        stream = join_streams([_as_trained(loaded, source, convert=whole) for source in opened])
        if isinstance(stream, RecordingStream):
            stream = RecordingStream(stream.sequence, part_frames(loaded, stream.sequence, part))
        elif not whole:
            raise OdometryError(f"{stream.name}: only a data set has a {part} part; run on all of it")
        if (unit := loaded.configuration["unit"]) != "m" and save is not None and save.suffix.lower() == ROS_SUFFIX:
            report_line(f"{save}: lengths are in {unit} of the model's own, where ROS expects metres", bold=True)
        # a signal stops the stream; what follows is brought to its end, so that results are kept
        with (
            stopping(gently=True) as signals,
            frame_sinks(stream.name, loaded.alpha, view=view, save=save, images=save_images) as sinks,
            progress_bars(out) as report,
        ):
            stop = StopWhen(limit, signals)
            answers = answer_stream(loaded, stream, out, report, part=part, sinks=sinks, stop=stop)
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


def _calibrated(model: PoseModel, stream: FrameStream, camera: Path | None, focal: str | None) -> FrameStream:
    """A source of a camera that a user names, as the model's camera would have seen it."""
    if stream.camera is not None:
        raise OptionError(
            f"--camera and --focal are for sources without calibration, and {stream.name} has {stream.camera}"
        )
    if camera is not None and focal is not None:
        raise OptionError("--focal cannot be used with --camera, which has a focal length")
    pixels = None
    if focal == "auto":
        pixels = fitted_focal(model, stream)
    elif focal is not None:
        try:
            pixels = float(focal)
        except ValueError:
            raise OptionError(f"--focal must be a number of pixels or auto, got {focal!r}") from None
    lens = lens_of(stream, camera, pixels)
    report_line(f"{stream.name}: images of {describe_change(lens, model.camera)}")
    return ConvertedStream(stream, lens, model.camera)


def fitted_focal(model: PoseModel, stream: FrameStream) -> float:
    """The focal length, pixels, with which the model recognises most landmarks in eight images of a source."""
    taken = [frame.image for frame in islice(stream, 0, _FRAMES * _APART, _APART) if frame.image is not None]
    if not taken or model.landmarks is None:
        raise OptionError(f"--focal auto: needs a model with landmarks, and images; give the pixels for {stream.name}")
    height, width = taken[0].shape[:2]

    def recognition(focal: float) -> float:
        lens = PinholeCamera(focal, focal, width / 2, height / 2, width, height)
        images = [view_as(image, lens, model.camera) for image in taken]
        local = [extract_local_features(grey_image(one), model.camera, model.detector) for one in images]
        network = np.concatenate([model.backbone.features_of(one) for one in images])
        return float(model.localizer.beliefs(FrameEvidence(network, local)).recognition.sum())

    best = max(_FOCALS * max(width, height), key=recognition)
    near = best * np.array([0.95, 1, 1.05])
    a, b, _ = np.polyfit(np.log(near), recognised := [recognition(focal) for focal in near.tolist()], 2)
    if not a < 0 or max(recognised) == 0:
        raise OptionError(f"--focal auto: no focal length makes {stream.name} recognised; give its pixels")
    return float(np.clip(np.exp(-b / (2 * a)), near[0], near[2]))


def _as_trained(model: PoseModel, stream: FrameStream, *, convert: bool) -> FrameStream:
    """Images of another camera as the model's camera would have seen them, or an error if they are not to be."""
    if stream.camera is None:
        return stream
    if stream.camera is model.camera and not isinstance(stream, ConvertedStream):
        names = f"{INTRINSICS} in it names" if isinstance(stream, RecordingStream) else "--camera or --focal name"
        report_line(f"{stream.name}: no calibration; the model's camera is assumed. {names} another")
    try:
        model.check_camera(stream.camera)
    except OdometryError as exc:
        if not convert:
            raise
        change = describe_change(stream.camera, model.camera)
        report_line(f"{exc}: its images are brought to the model's camera, those of {change}")
        if isinstance(stream, RecordingStream):
            return replace(stream, sequence=as_camera(stream.sequence, model.camera))
        return ConvertedStream(stream, stream.camera, model.camera)
    return stream


@contextmanager
def frame_sinks(name: str, alpha: object, *, view: bool, save: Path | None, images: bool) -> Iterator[list[FrameSink]]:
    """The views and recordings that the options of a run ask for; all are closed at the end."""
    ros = save if save is not None and save.suffix.lower() == ROS_SUFFIX else None
    rerun = None if ros else save
    sinks: list[FrameSink] = []
    with ExitStack() as stack:
        if view or rerun is not None:
            from conformodal.report.live import LiveView  # noqa: PLC0415 - an extra

            live = LiveView(name, alpha, spawn=view, save=rerun)
            stack.callback(live.close)
            sinks.append(live.log)
        if ros is not None:
            from conformodal.ros.bag import BagWriter  # noqa: PLC0415 - an extra

            # closed first: it is not kept after an error
            sinks.append(stack.enter_context(BagWriter(ros, images=images)).log)
        yield sinks
