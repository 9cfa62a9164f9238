"""Writing a source in another layout."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.geometry import PinholeCamera, Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S, clock_hint
from conformodal.io.streams.frames import Frame, FrameStream, RecordingStream

from .cameras import DISTORTION, INTRINSICS
from .decoding import is_turned
from .errors import DatasetError
from .folders import staged
from .reading import Note
from .registry import Layout

WRITABLE = (Layout.TUM, Layout.IMAGES)


@dataclass
class ConversionReport:
    """How many frames were written, and with a pose; the notes name those that were left out."""

    n_frames: int
    n_posed: int
    notes: list[Note]


def write_layout(
    folder: Path,
    layout: str,
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
    if layout not in WRITABLE:
        raise DatasetError(f"layout must be one of {', '.join(WRITABLE)}, got {layout!r}")
    notes: list[Note] = []
    written: list[Frame] = []  # without their images
    names: list[str] = []
    with staged(folder) as part:
        below = "rgb/" if layout == Layout.TUM else ""
        (part / below).mkdir(exist_ok=True)
        for number, frame in enumerate(stream, start=1):
            if written and frame.recording != written[-1].recording:
                raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
            if frame.image is None or frame.image.shape[:2] != (camera.height, camera.width):
                notes.append(Note("left out, no image of the camera's size", frame.problem or frame.name))
            elif not frame.timestamp_s > (written[-1].timestamp_s if written else -np.inf):
                notes.append(Note("left out, time goes back", frame.name))
            else:
                stem = part / below / f"{len(names):06d}"
                names.append(below + _write_image(stem, frame, stream).name)
                written.append(Frame(frame.name, frame.timestamp_s, None, recording=frame.recording))
            if progress is not None:
                progress(number)
        if not written:
            raise DatasetError(f"{stream.name}: nothing to write: {len(notes)} frames without an image or a time")
        times = np.array([frame.timestamp_s for frame in written])
        np.savetxt(part / INTRINSICS, camera.matrix)
        if camera.distortion:
            np.savetxt(part / DISTORTION, camera.distortion)
        listed = zip(times.tolist(), names, strict=True)
        lines = [f"{time:.9f} {name}" if below else f"{time:.9f}" for time, name in listed]
        _write_lines(part / ("rgb.txt" if below else "times.txt"), lines)
        n_posed = 0
        if poses is not None:
            rows = poses_at(poses, times, max_gap_s).rows
            without = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
            n_posed = len(rows) - len(without)
            if not n_posed:
                raise DatasetError(f"{stream.name}: no frame has a pose{clock_hint(times, poses.timestamps_s)}")
            notes += [Note("kept without a pose", written[i].name) for i in without]
            # a frame without a pose has a row of NaN: else one between its neighbours' would be read back for it
            tum = np.column_stack((rows[:, :3], np.roll(rows[:, 3:], -1, axis=1))).tolist()
            lines = [f"{time:.9f} {' '.join(map(repr, row))}" for time, row in zip(times.tolist(), tum, strict=True)]
            head = "# timestamp tx ty tz qx qy qz qw"
            _write_lines(part / ("groundtruth.txt" if below else "poses.tum"), [head, *lines])
    return ConversionReport(len(times), n_posed, notes)


def _write_image(stem: Path, frame: Frame, stream: FrameStream) -> Path:
    """Copy the image of a data set's frame, or write that of another source, without losses."""
    source = stream.sequence.image_paths[frame.index] if isinstance(stream, RecordingStream) else Path()
    if source.suffix in (".png", ".jpg") and not is_turned(source):
        return Path(shutil.copyfile(source, stem.with_suffix(source.suffix)))
    Image.fromarray(np.asarray(frame.image)).save(stem.with_suffix(".png"))
    return stem.with_suffix(".png")


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
