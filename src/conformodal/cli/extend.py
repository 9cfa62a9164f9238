"""``conformodal extend``: teach a saved model recordings that came later, after testing it on them."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from conformodal.core.words import counted
from conformodal.features.extract import FeatureCache
from conformodal.io import DatasetError, DatasetWarning, Layout, Recording, read_recording
from conformodal.io.cameras import INTRINSICS
from conformodal.io.convert import convert_stream
from conformodal.io.streams import FrameStream, RecordingStream, SourceError, open_stream
from conformodal.io.streams.bag import is_bag
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.extend import ASSUMPTION, check_extension, extend_model
from conformodal.pipeline.guarantee import describe_guarantee, short_guarantee
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import lock_output, write_metrics
from conformodal.pipeline.store import load_model, model_digest, save_model
from conformodal.pipeline.whole_recordings import describe_units

from .console import AsJson, Quiet, Verbose, print_json, print_where, progress_bars, report_line, warning_lines
from .sources import Cache, DataLayout, SavedModel, cache_folder, open_sequences, report_notes

_FRAMES = ".frames-of-videos"  # in the output folder, until the end


def extend(
    model: SavedModel,
    new: Annotated[list[Path], typer.Argument(metavar="NEW...", help="Recordings with or without poses, videos.")],
    out: Annotated[Path, typer.Option(help="Folder for the extended model; must not hold one.")],
    layout: DataLayout = Layout.AUTO,
    trust_poses: Annotated[bool, typer.Option(help="Take poses that do not fit the images.")] = False,
    cache: Cache = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Extend a model by new recordings, in their order: each is answered first, then joins the map.

    Scores of those with poses calibrate. Of those without, reliable frames join at the model's own answers.
    """
    started = time.perf_counter()
    if (out / "model.json").exists():
        raise OdometryError(f"{out}: holds a model already; name a new folder")
    with lock_output(out, "extend", apart=[*new, model]), _removed_after(out / _FRAMES) as frames:
        before = load_model(model)
        features = FeatureCache(cache_folder(cache))
        recordings = [
            open_recording(before, path, layout, frames / str(k), trust_poses=trust_poses) for k, path in enumerate(new)
        ]
        checked = [check_extension(before, recording) for recording in recordings]
        for k, (recording, identities) in enumerate(zip(recordings, checked, strict=True)):
            if n := sum(int(earlier.known(identities).sum()) for earlier in checked[:k]):
                raise OdometryError(f"{recording.name}: {n} of its images are in a recording before it")
        with progress_bars(out) as report:
            after = extend_model(before, recordings, cache=features, progress=report)
        save_model(after, out)
        entries = after.journal[len(before.journal) :]
        summary = [
            f"coverage: {short_guarantee(after)}",
            f"joined: {'; '.join(entry.describe() for entry in entries)}",
            f"next: conformodal run {out} SOURCE --out OUT",
        ]
        metrics = {
            "command": "extend",
            "model": model_digest(out),
            "extends": model_digest(model),
            "provenance": provenance(),
            "configuration": after.settings,
            "seed": after.split.seed,
            "guarantee": describe_guarantee(after),
            "verdict": summary,
            "seconds": round(time.perf_counter() - started, 2),
        }
        write_metrics(out, metrics)
    report_line(summary[0])
    for entry in entries:
        report_line(entry.describe())
    report_line(summary[-1])
    report_detail = partial(report_line, detail=True)
    for line in (describe_units(after), *([ASSUMPTION] if after.journal_with_poses else []), describe_guarantee(after)):
        report_detail(line)
    print_where(out)
    print_json(metrics)


@contextmanager
def _removed_after(folder: Path) -> Iterator[Path]:
    """A folder that is not there before, whatever a killed command has left, nor afterwards."""
    shutil.rmtree(folder, ignore_errors=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def open_recording(model: PoseModel, path: Path, layout: Layout, frames: Path, *, trust_poses: bool) -> Recording:
    """A recording with poses; or one without, as the model's camera took it, whose frames are written if it has none.

    `frames` is the folder for the frames of a video or a ROS recording.
    """
    is_film = layout is Layout.AUTO and (path.is_file() or is_bag(path))
    with warnings.catch_warnings():  # they are printed here, or when it is read again
        warnings.simplefilter("ignore", DatasetWarning)
        stream = open_stream(path, layout, camera=None if is_film else model.camera)
    if isinstance(stream, RecordingStream) and stream.sequence.poses is not None:
        return open_sequences([path], layout, trust_poses=trust_poses)
    if stream.live:
        raise SourceError(f"{path}: is a live camera, expected a recording; record it first")
    report_line(f"{path}: no poses, so only frames of which the model is sure join, at its own answers")
    report_notes(stream.notes)
    if stream.camera in (None, model.camera):
        report_line(f"{path}: taken for the model's camera, unless {INTRINSICS} in it or the source names another")
    return stream.sequence if isinstance(stream, RecordingStream) else _written(stream, model, frames)


def _written(stream: FrameStream, model: PoseModel, folder: Path) -> Recording:
    """The frames of a video as images in a folder, without a loss."""
    camera = model.camera if stream.camera is None else stream.camera
    size = next((frame.image.shape[1::-1] for frame in stream if frame.image is not None), None)
    if size is not None and size != (camera.width, camera.height):
        expected = f"{camera.width}x{camera.height}"
        raise DatasetError(f"{stream.name}: has images of {size[0]}x{size[1]} pixels, expected the model's {expected}")
    folder.parent.mkdir(exist_ok=True)
    with progress_bars() as report, warning_lines(DatasetWarning):
        written = convert_stream(folder, stream, camera, None, lambda done: report("video", done, stream.n_frames or 0))
        recording = read_recording(folder, Layout.TUM, require_poses=False)
    report_notes(written.notes)
    report_line(f"{stream.name}: {counted(written.n_frames, 'frame')}")
    return replace(recording, name=stream.name)
