"""Writing a source as a data set in TUM's layout."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.geometry import PinholeCamera, Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io.diagnosis.clocks import clock_hint
from conformodal.io.streams.frames import Frame, FrameStream, RecordingStream

from .cameras import DISTORTION, INTRINSICS
from .decoding import is_turned
from .errors import DatasetError
from .folders import staged
from .pose_files import TUM_HEADER
from .reading import Note


@dataclass
class ConversionReport:
    """How many frames were written, and with a pose; the notes name those that were left out."""

    n_frames: int
    n_posed: int
    notes: list[Note]


def convert_stream(
    folder: Path,
    stream: FrameStream,
    camera: PinholeCamera,
    poses: Trajectory | None,
    progress: Callable[[int], None] | None = None,
    max_gap_s: float = MAX_GAP_S,
) -> ConversionReport:
    """Write the frames of a source, one after the other; images that lie in files are copied as they are.

    They are written beside the folder, which is new or empty, and moved into its place at the end: a failure leaves
    nothing there. Poses are paired by time; frames without one are kept without. `max_gap_s` is the longest time
    between two poses that one is interpolated from; 0 for poses with the frames' own times.
    """
    notes: list[Note] = []
    names: list[str] = []  # of the frames that are written
    files: list[str] = []
    times: list[float] = []
    recording = None
    with staged(folder) as part:
        (part / "rgb").mkdir()
        for number, frame in enumerate(stream, start=1):
            if recording not in (None, frame.recording):
                raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
            if frame.image is None or frame.image.shape[:2] != (camera.height, camera.width):
                notes.append(Note("left out, no image of the camera's size", frame.problem or frame.name))
            elif not frame.timestamp_s > (times[-1] if times else -np.inf):
                notes.append(Note("left out, time goes back", frame.name))
            else:
                recording = frame.recording
                files.append(f"rgb/{_write_image(part / 'rgb' / f'{len(names):06d}', frame, stream).name}")
                names.append(frame.name)
                times.append(frame.timestamp_s)
            if progress is not None:
                progress(number)
        if not names:
            raise DatasetError(f"{stream.name}: nothing to write: {len(notes)} frames without an image or a time")
        np.savetxt(part / INTRINSICS, camera.matrix)
        if camera.distortion:
            np.savetxt(part / DISTORTION, camera.distortion)
        _write_lines(part / "rgb.txt", [f"{time:.9f} {file}" for time, file in zip(times, files, strict=True)])
        if poses is None:
            return ConversionReport(len(names), 0, notes)
        rows = poses_at(poses, np.array(times), max_gap_s).rows
        without = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
        if len(without) == len(names):
            raise DatasetError(f"{stream.name}: no frame has a pose{clock_hint(np.array(times), poses.timestamps_s)}")
        notes += [Note("kept without a pose", names[i]) for i in without]
        # a frame without a pose has a row of NaN: else one between its neighbours' would be read back for it
        tum = np.column_stack((rows[:, :3], np.roll(rows[:, 3:], -1, axis=1))).tolist()
        lines = [f"{time:.9f} {' '.join(map(repr, row))}" for time, row in zip(times, tum, strict=True)]
        _write_lines(part / "groundtruth.txt", [TUM_HEADER, *lines])
    return ConversionReport(len(names), len(names) - len(without), notes)


def _write_image(stem: Path, frame: Frame, stream: FrameStream) -> Path:
    """Copy the image of a data set's frame, or write that of another source, without losses."""
    source = stream.sequence.image_paths[frame.index] if isinstance(stream, RecordingStream) else Path()
    if source.suffix in (".png", ".jpg") and not is_turned(source):
        return Path(shutil.copyfile(source, stem.with_suffix(source.suffix)))
    Image.fromarray(np.asarray(frame.image)).save(stem.with_suffix(".png"))
    return stem.with_suffix(".png")


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
