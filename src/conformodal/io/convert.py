"""Writing a source in another layout."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S, clock_hint
from conformodal.io.streams.frames import Frame, FrameStream
from conformodal.io.streams.stored import RecordingStream

from .cameras import DISTORTION, INTRINSICS
from .decoding import is_turned
from .errors import DatasetError
from .folders import staged
from .registry import Layout

# Where images go, and how they are named: by number, or time in seconds.
_PLACES: dict[str, tuple[str, str]] = {
    Layout.TUM: ("rgb", "{time_s:.6f}"),
    Layout.IMAGES: ("", "{number:06d}"),
}
WRITABLE = tuple(_PLACES)
_MOST_NAMES = 20


@dataclass
class ConversionReport:
    """How many frames were written, and with a pose; the notes, for people, name those that were left out."""

    n_frames: int
    n_posed: int
    notes: list[str]


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
    if isinstance(stream, RecordingStream):  # what is known before the first frame is read
        if len(np.unique(stream.sequence.recording)) > 1:
            raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
        _pair(stream.name, stream.sequence.timestamps_s, poses, max_gap_s)
    with staged(folder) as part:
        writer = _ImageWriter(part, layout, (camera.width, camera.height))
        for number, frame in enumerate(stream, start=1):
            writer.add(frame, stream)
            if progress is not None:
                progress(number)
        if not writer.names:
            left = f"{len(writer.unreadable)} unreadable, no time for the rest"
            raise DatasetError(f"{stream.name}: nothing to write: {left}")
        times = np.array(writer.times)
        rows = _pair(stream.name, times, poses, max_gap_s)
        _write_beside(layout, part, writer.names, times, rows, camera)
    posed = np.isfinite(rows).all(axis=1)
    without_pose = [] if poses is None else [writer.sources[i] for i in np.flatnonzero(~posed)]
    left_out = {
        "left out {} without an image": writer.unreadable,
        "left out {} whose time goes back": writer.without_time,
        "kept {} without a pose": without_pose,
    }
    notes = [_listed(why, names) for why, names in left_out.items() if names] + writer.problems[:1]
    return ConversionReport(len(times), int(posed.sum()), notes)


def _pair(name: str, times: FloatArray, poses: Trajectory | None, max_gap_s: float) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of frames, interpolated by time; NaN where there is none."""
    if poses is None:
        return np.full((len(times), 7), np.nan)
    rows, _ = poses_at(poses, times, max_gap_s)
    if not np.isfinite(rows).any():
        hint = clock_hint(times, poses.timestamps_s) if len(times) else ""
        raise DatasetError(f"{name}: no frame has a pose by its time{hint}")
    return rows


class _ImageWriter:
    """Writes the images of frames one after the other, and lists those that are left out."""

    def __init__(self, folder: Path, layout: str, size: tuple[int, int]) -> None:
        below, self.pattern = _PLACES[layout]
        self.place, self.size, self.recording = folder / below, size, 0
        self.place.mkdir(parents=True, exist_ok=True)
        self.sources: list[str] = []  # names in the source of what is written, and here
        self.names: list[str] = []
        self.times: list[float] = []
        self.unreadable: list[str] = []
        self.without_time: list[str] = []
        self.problems: list[str] = []

    def add(self, frame: Frame, stream: FrameStream) -> None:
        """Write a frame's image, or take up why it is left out."""
        if self.times and frame.recording != self.recording:
            raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
        if frame.image is None or frame.image.shape[1::-1] != self.size:
            self.unreadable.append(frame.name)
            self.problems += [frame.problem] if frame.problem else []
        elif not np.isfinite(frame.timestamp_s) or (self.times and frame.timestamp_s <= self.times[-1]):
            self.without_time.append(frame.name)
        else:
            self.names.append(self._write(frame, stream))
            self.sources.append(frame.name)
            self.times.append(frame.timestamp_s)
            self.recording = frame.recording

    def _write(self, frame: Frame, stream: FrameStream) -> str:
        source = stream.sequence.image_paths[frame.index] if isinstance(stream, RecordingStream) else Path()
        upright = source.suffix in (".png", ".jpg") and not is_turned(source)
        stem = self.pattern.format(number=len(self.names), time_s=frame.timestamp_s)
        target = self.place / f"{stem}{source.suffix if upright else '.png'}"
        if target.exists():
            raise DatasetError(f"{target}: two frames have this name")
        if upright:
            shutil.copyfile(source, target)
        else:
            Image.fromarray(np.asarray(frame.image)).save(target)
        return target.name


def _listed(why: str, names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"{why.format(counted(len(names), 'frame'))}: {', '.join(names[:_MOST_NAMES])}{more}"


def _write_beside(
    layout: str, folder: Path, names: list[str], times: FloatArray, rows: FloatArray, camera: PinholeCamera
) -> None:
    """Write what a layout has beside its images: times, camera, poses (n, 7)."""
    if layout == Layout.TUM:
        lines = [f"{time:.9f} rgb/{name}" for time, name in zip(times.tolist(), names, strict=True)]
        _write_lines(folder / "rgb.txt", ["# timestamp filename", *lines])
    else:
        np.savetxt(folder / "times.txt", times, fmt="%.9f")
    np.savetxt(folder / INTRINSICS, camera.matrix)
    if camera.distortion:
        np.savetxt(folder / DISTORTION, camera.distortion)
    if np.isfinite(rows).any():
        # a frame without a pose has a row of NaN: else one between its neighbours' would be read back for it
        poses = np.column_stack((rows[:, :3], np.roll(rows[:, 3:], -1, axis=1))).tolist()
        lines = [f"{time:.9f} {' '.join(map(repr, row))}" for time, row in zip(times.tolist(), poses, strict=True)]
        name = "groundtruth.txt" if layout == Layout.TUM else "poses.tum"
        _write_lines(folder / name, ["# timestamp tx ty tz qx qy qz qw", *lines])


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
