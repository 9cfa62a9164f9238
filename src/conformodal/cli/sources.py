"""Arguments of several commands, and opening what a user names as data."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from conformodal.core.files import default_cache_dir, usable_cache_dir
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io import DatasetError, DatasetWarning, Layout, Recording, read_recording, recognise
from conformodal.io.cameras import camera_beside, uncalibrated_camera
from conformodal.io.diagnosis.order import diagnose
from conformodal.io.folders import check_writable
from conformodal.io.pose_files import read_tum
from conformodal.io.reading import Note, group_by_kind
from conformodal.io.recording import join_recordings
from conformodal.io.streams import open_stream
from conformodal.io.streams.bag import BagStream
from conformodal.io.streams.frames import FrameStream, RecordingStream

from .console import OUTPUT_PANEL, OptionError, report_line, warning_lines

_MAX_NOTES = 5

DATA_PANEL = "Data and split"
AllData = Annotated[list[Path], typer.Argument(metavar="DATA...", help="Images with poses, in one world frame.")]
SavedModel = Annotated[Path, typer.Argument(help="Folder of a saved model.")]
DataLayout = Annotated[Layout, typer.Option("--format", help="Layout of the data set.", rich_help_panel=DATA_PANEL)]
MaxGap = Annotated[float, typer.Option(min=0, help="Longest gap, seconds, between two poses to interpolate between.")]
TimeOffset = Annotated[float, typer.Option(help="Seconds to add to the times of the poses.")]
Focal = Annotated[float | None, typer.Option(help="Pixels, of images without a camera.", rich_help_panel=DATA_PANEL)]
Camera = Annotated[Path | None, typer.Option(help="camera-intrinsics.txt (3x3), or its folder, of a video or device.")]
Cache = Annotated[Path | None, typer.Option(help="Cache folder (default: the user's).", rich_help_panel=OUTPUT_PANEL)]


def cache_folder(cache: Path | None) -> Path | None:
    """The cache folder that a user named, or the usual one, which can be written; else a temporary one, or none."""
    if cache is not None or "CONFORMODAL_CACHE" in os.environ:
        folder = cache or default_cache_dir()
        check_writable(folder)
        return folder
    usual = default_cache_dir()
    try:
        folder = usable_cache_dir()
    except OSError:
        report_line(f"{usual}: cannot be written, and nothing is cached; --cache FOLDER names a folder")
        return None
    if folder != usual:
        report_line(f"{usual}: cannot be written; {folder} is used until the end, and --cache FOLDER keeps what it has")
    return folder


def was_given(context: typer.Context, name: str) -> bool:
    """Whether a user has given an option, even with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and not source.name.startswith("DEFAULT")


def report_notes(notes: Iterable[Note]) -> None:
    """Name what the reader left out, or finds unlikely."""
    for what, places in group_by_kind(notes).items():
        for where in places[:_MAX_NOTES]:
            report_line(f"{what}: {where}")
        if len(places) > _MAX_NOTES:
            report_line(f"{what}: {len(places) - _MAX_NOTES} more")


def open_sequence(path: Path, layout: Layout, *, notes: bool = True, **options: Any) -> Recording:
    """Read a data set in a layout; says what was recognised, and the reader's notes.

    Options are those of :func:`~conformodal.read_recording`.
    """
    name = recognise(path) if layout is Layout.AUTO else str(layout)
    if layout is Layout.AUTO:
        report_line(f"{path}: {name} layout")
    with warnings.catch_warnings():  # they are printed here
        warnings.simplefilter("ignore", DatasetWarning)
        sequence = read_recording(path, name, **options)
    if notes:
        report_notes(sequence.notes)
    return sequence


def open_sequences(
    paths: Sequence[Path], layout: Layout, *, test: Path | None = None, trust_poses: bool = False, **options: Any
) -> Recording:
    """Read data sets as one, see :func:`~conformodal.io.recording.join_recordings`; `test` is one that tests.

    Those whose poses do not fit their images are refused, unless the poses are trusted.
    """
    every = [*paths, *([] if test is None else [test])]
    parts = [open_sequence(path, layout, require_poses=True, **options) for path in every]
    for part in parts:
        if cause := diagnose(part):
            what = f"{part.name}: poses do not fit the images: {cause}"
            if not trust_poses:
                raise DatasetError(f"{what}; --trust-poses trains all the same")
            report_line(what, bold=True)
    whole = join_recordings(parts, None if test is None else [path is test for path in every])
    report_notes(whole.notes[sum(len(part.notes) for part in parts) :])
    return whole


def lens_of(stream: FrameStream, camera: Path | None, focal: float | None = None) -> PinholeCamera:
    """The camera of a source without calibration, from a file or a focal length in pixels."""
    first = next((frame.image for frame in stream if frame.image is not None), None)
    if first is None:
        raise DatasetError(f"{stream.name}: no image can be read, so the size of the images is not known")
    size, notes = (first.shape[1], first.shape[0]), list[Note]()
    if camera is None:
        lens: PinholeCamera | None = uncalibrated_camera(stream.name, size, focal, notes)
    else:
        lens = camera_beside(camera, size, None, notes)
    if lens is None:
        what = (
            "holds no camera-intrinsics.txt with"
            if Path(str(camera)).is_dir()
            else "no such file or folder; name one with"
        )
        raise DatasetError(f"{camera}: {what} the 3x3 matrix of the camera")
    report_notes(notes)
    return lens


def read_poses(
    source: Path | str, offset_s: float = 0.0, stream: FrameStream | None = None, max_gap_s: float = MAX_GAP_S
) -> Trajectory:
    """The poses of a TUM file, or of a ROS recording's topic, moved in time; says what is wrong with some."""
    if isinstance(stream, BagStream) and not Path(source).exists():
        from conformodal.io.streams.bag_poses import read_bag_poses  # noqa: PLC0415 - of ROS recordings alone

        notes = list[Note]()
        poses = read_bag_poses(stream, str(source), notes, max_gap_s)
        report_notes(notes)
    else:
        with warning_lines(Warning):
            poses = read_tum(Path(source))
    return replace(poses, timestamps_s=poses.timestamps_s + offset_s)


def open_source(
    source: str, layout: Layout, *, topic: str | None = None, as_trained: bool = False, **options: Any
) -> FrameStream:
    """Open anything that gives frames, see :func:`~conformodal.io.streams.open_stream`; says what it is.

    With `as_trained`, a data set where only some frames have poses is read as for training: without the others.
    """
    with warnings.catch_warnings():  # they are printed here
        warnings.simplefilter("ignore", DatasetWarning)
        stream = open_stream(source, layout, topic=topic, **options)
        if as_trained and isinstance(stream, RecordingStream) and stream.sequence.truth is None:
            with suppress(DatasetError):  # no frame has a pose
                stream = RecordingStream(read_recording(Path(source), layout))
    if topic is not None and not isinstance(stream, BagStream):
        raise OptionError(f"--topic is for ROS recordings, and {source} is not one, got {topic!r}")
    kind = type(stream).__name__.removesuffix("Stream").lower()
    if isinstance(stream, RecordingStream):
        name = recognise(Path(source), images_alone=True) if layout is Layout.AUTO else layout
        kind = f"{name} layout"
        kind += ", without poses, or not for every frame" if stream.sequence.truth is None else ", with poses"
    count = "" if stream.n_frames is None else f", {counted(stream.n_frames, 'frame')}"
    report_line(f"{source}: {kind}{count}")
    report_notes(stream.notes)
    return stream
