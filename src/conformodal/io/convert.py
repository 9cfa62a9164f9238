"""Writing a source in another layout."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.ranges import as_member
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, Trajectory, matrix_from_quat_wxyz, poses_at
from conformodal.geometry.metrics import MAX_GAP_S, clock_hint
from conformodal.io.streams.frames import Frame, FrameStream
from conformodal.io.streams.stored import RecordingStream

from .decoding import orientation
from .errors import DatasetError
from .reading import FRAME_RATE_HZ
from .registry import Layout
from .staging import staged

# Where images go, and how they are named: by number, or time in seconds.
_PLACES: dict[Layout, tuple[str, str]] = {
    Layout.SEVENSCENES: ("", "frame-{number:06d}.color"),
    Layout.TUM: ("rgb", "{time_s:.6f}"),
    Layout.IMAGES: ("", "{number:06d}"),
    Layout.COLMAP: ("images", "{number:06d}"),
}
WRITABLE = tuple(_PLACES)
_MOST_NAMES = 20
_UNEVEN = 0.2  # of a frame's time
_MOST_NUMBERED = 999_999  # six digits


@dataclass
class ConversionReport:
    """What was written, and what was not; the notes name the frames.

    Attributes
    ----------
    n_frames, n_posed
        Written, and how many of them with a pose.
    n_unreadable, n_without_time
        Left out.
    notes
        For people.
    """

    n_frames: int = 0
    n_posed: int = 0
    n_unreadable: int = 0
    n_without_time: int = 0
    notes: list[str] = field(default_factory=list)


def write_layout(
    folder: Path,
    layout: Layout | str,
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

    Raises
    ------
    DatasetError
        If the folder holds something, the layout cannot be written or cannot hold several recordings or no poses, a
        name would be used twice, or nothing is left to write.
    """
    layout = as_member(layout, Layout, "layout", DatasetError)
    if layout not in _PLACES:
        raise DatasetError(f"layout {layout} is read only; can be written: {', '.join(WRITABLE)}")
    if poses is None and layout is Layout.COLMAP:
        raise DatasetError(f"{layout} needs poses")
    several = isinstance(stream, RecordingStream) and len(np.unique(stream.sequence.recording)) > 1
    if several and layout is not Layout.SEVENSCENES:
        raise DatasetError(
            f"{stream.name}: holds several recordings, and {layout} has a place for one; write 7scenes, or convert one "
            "at a time"
        )
    if isinstance(stream, RecordingStream):  # what is known before the first frame is read
        _pair(stream.name, stream.sequence.timestamps_s, poses, max_gap_s)
    with staged(folder) as part:
        frames = _Frames(part, layout, several)
        for number, frame in enumerate(stream, start=1):
            frames.take(frame, stream, camera)
            if progress is not None:
                progress(number)
        return frames.finish(stream.name, camera, poses, max_gap_s)


def _pair(name: str, times: FloatArray, poses: Trajectory | None, max_gap_s: float) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of frames, interpolated by time; NaN where there is none."""
    if poses is None:
        return np.full((len(times), 7), np.nan)
    rows, _ = poses_at(poses, times, max_gap_s)
    if not np.isfinite(rows).any():
        hint = clock_hint(times, poses.timestamps_s) if len(times) else ""
        raise DatasetError(f"{name}: no frame has a pose by its time{hint}")
    return rows


class _Frames:
    """Frames as they are written; see :func:`write_layout` for the parameters."""

    def __init__(self, folder: Path, layout: Layout, several: bool) -> None:
        self.folder, self.layout, self.several = folder, layout, several
        self.place, self.pattern = folder / _PLACES[layout][0], _PLACES[layout][1]
        self.place.mkdir(parents=True, exist_ok=True)
        self.rows: list[tuple[str, str, float, int]] = []  # names in the source and here, time, recording
        self.counts: Counter[int] = Counter()  # frames by recording
        self.unreadable: list[str] = []
        self.without_time: list[str] = []
        self.problem = ""  # of the first that cannot be read

    def take(self, frame: Frame, stream: FrameStream, camera: PinholeCamera) -> None:
        """Write a frame's image, or take up why it is left out."""
        if not self.several and self.rows and frame.recording != self.rows[-1][3]:
            raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
        if frame.image is None or frame.image.shape[:2] != (camera.height, camera.width):
            self.unreadable.append(frame.name)
            self.problem = self.problem or frame.problem
        elif not np.isfinite(frame.timestamp_s) or (self.rows and frame.timestamp_s <= self.rows[-1][2]):
            self.without_time.append(frame.name)
        else:
            name = self._image(frame, stream)
            self.rows.append((frame.name, name, frame.timestamp_s, frame.recording))
            self.counts[frame.recording] += 1

    def _image(self, frame: Frame, stream: FrameStream) -> str:
        place = self.place / f"seq-{frame.recording + 1:02d}" if self.several else self.place
        place.mkdir(exist_ok=True)
        source = stream.sequence.image_paths[frame.index] if isinstance(stream, RecordingStream) else Path()
        upright = source.suffix in (".png", ".jpg") and orientation(source)[0] == 1
        suffix = source.suffix if upright else ".png"
        stem = self.pattern.format(number=self.counts[frame.recording], time_s=frame.timestamp_s)
        target = place / f"{stem}{suffix}"
        if target.exists():
            raise DatasetError(f"{target}: two frames have this name")
        if upright:
            shutil.copyfile(source, target)
        else:
            Image.fromarray(np.asarray(frame.image)).save(target)
        return str(target.relative_to(self.place))

    def finish(self, name: str, camera: PinholeCamera, truth: Trajectory | None, max_gap_s: float) -> ConversionReport:
        """Write everything but the images."""
        if not self.rows:
            raise DatasetError(f"{name}: nothing to write: {len(self.unreadable)} unreadable, no time for the rest")
        sources, names = [row[0] for row in self.rows], [row[1] for row in self.rows]
        times, recording = np.array([row[2] for row in self.rows]), np.array([row[3] for row in self.rows])
        poses = _pair(name, times, truth, max_gap_s)
        posed = np.asarray(np.isfinite(poses).all(axis=1))
        notes = _write(self.layout, self.folder, names, times, recording, poses, camera)
        left = {
            "left out {} without an image": self.unreadable,
            "left out {} whose time goes back": self.without_time,
            "kept {} without a pose": [sources[i] for i in np.flatnonzero(~posed) if truth is not None],
        }
        told = [_listed(why, frames) for why, frames in left.items() if frames]
        told += [self.problem] if self.problem else []
        counts = int(posed.sum()), len(self.unreadable), len(self.without_time)
        return ConversionReport(len(names), *counts, told + notes)


def _listed(why: str, frames: list[str]) -> str:
    more = f" and {len(frames) - _MOST_NAMES} more" if len(frames) > _MOST_NAMES else ""
    return f"{why.format(counted(len(frames), 'frame'))}: {', '.join(frames[:_MOST_NAMES])}{more}"


def _write(
    layout: Layout,
    folder: Path,
    names: list[str],
    times: FloatArray,
    recording: IntArray,
    poses: FloatArray,
    camera: PinholeCamera,
) -> list[str]:
    """Write what a layout has beside its images: times, camera, poses (n, 7); says what was lost."""
    at = np.flatnonzero(np.isfinite(poses).all(axis=1))
    truth = Trajectory(times[at], poses[at, :3], poses[at, 3:])
    lost: list[str] = []
    if layout is Layout.SEVENSCENES:
        rate, numbers, even = _numbered_by_time(times, recording)
        for i in reversed(range(len(names))):  # numbers only grow, so the place of the new name is free
            old = folder / names[i]
            names[i] = str(Path(names[i]).with_name(f"frame-{numbers[i]:06d}.color{old.suffix}"))
            old.rename(folder / names[i])
        for i, pose in zip(at.tolist(), truth.poses_se3, strict=True):
            np.savetxt(folder / Path(names[i]).with_name(f"frame-{numbers[i]:06d}.pose.txt"), pose, fmt="%.17g")
        np.savetxt(folder / "frame-rate.txt", [rate])
        lost = [] if even else [f"7scenes has no timestamps: they are read back as even, {rate:.3f} Hz"]
    elif layout is Layout.TUM:
        lines = [f"{time:.9f} rgb/{name}" for time, name in zip(times.tolist(), names, strict=True)]
        _write_lines(folder / "rgb.txt", ["# timestamp filename", *lines])
    else:
        np.savetxt(folder / "times.txt", times, fmt="%.9f")
    if layout is Layout.COLMAP:
        _write_colmap(folder / "sparse" / "0", [names[i] for i in at], truth, camera)
        return lost
    np.savetxt(folder / "camera-intrinsics.txt", camera.matrix)
    if camera.distortion:
        np.savetxt(folder / "camera-distortion.txt", camera.distortion)
    if len(truth) and layout in (Layout.TUM, Layout.IMAGES):
        # a frame without a pose has a row of NaN: else one between its neighbours' would be read back for it
        rows = np.column_stack((poses[:, :3], np.roll(poses[:, 3:], -1, axis=1))).tolist()
        lines = [f"{time:.9f} {' '.join(map(repr, row))}" for time, row in zip(times.tolist(), rows, strict=True)]
        name = "groundtruth.txt" if layout is Layout.TUM else "poses.tum"
        _write_lines(folder / name, ["# timestamp tx ty tz qx qy qz qw", *lines])
    return lost


def _numbered_by_time(times: FloatArray, recording: IntArray) -> tuple[float, IntArray, bool]:
    """Frame rate, number of every frame in its recording, and whether both say its time.

    Frames that are missing leave a gap in the numbers. Times that no rate fits are numbered one after the other.
    """
    first = np.flatnonzero(np.diff(recording, prepend=-1) != 0)
    start = np.repeat(first, np.diff(np.append(first, len(times))))
    counted_on = np.arange(len(times)) - start
    inner = np.flatnonzero(np.diff(recording) == 0)
    steps = np.diff(times)[inner]
    if not steps.size:
        return FRAME_RATE_HZ, counted_on, True
    passed = times - times[start]
    for step in (np.median(steps), steps.min()):  # where most frames are missing, few steps are of one frame
        rise = np.zeros(len(times))
        rise[inner + 1] = np.maximum(np.rint(steps / step), 1)
        total = np.cumsum(rise)
        numbers = total - total[start]
        rate = float(numbers @ numbers / (numbers @ passed))
        if np.abs(passed * rate - numbers).max() <= _UNEVEN and numbers.max() <= _MOST_NUMBERED:
            return rate, numbers.astype(np.int64), True
    return 1 / float(np.median(steps)), counted_on, False


def _write_colmap(place: Path, names: list[str], truth: Trajectory, camera: PinholeCamera) -> None:
    """Write a model of one camera with its images' poses into a new folder, as text."""
    values = [float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)]
    model = {0: "PINHOLE", 4: "OPENCV", 5: "FULL_OPENCV"}[len(camera.distortion)]
    values += [0.0] * 3 if model == "FULL_OPENCV" else []
    back = truth.orientations_quat_wxyz * (1, -1, -1, -1)
    shifts = -np.einsum("nij,nj->ni", matrix_from_quat_wxyz(back), truth.positions_xyz)
    lines = ["# id qw qx qy qz tx ty tz camera name, world to camera; after it a line of points, here empty"]
    for number, (name, row) in enumerate(zip(names, np.column_stack((back, shifts)).tolist(), strict=True), start=1):
        lines += [f"{number} {' '.join(map(repr, row))} 1 {name}", ""]
    place.mkdir(parents=True)
    size = f"{camera.width} {camera.height}"
    _write_lines(
        place / "cameras.txt", ["# id model width height parameters", f"1 {model} {size} {' '.join(map(repr, values))}"]
    )
    _write_lines(place / "images.txt", lines)
    _write_lines(place / "points3D.txt", ["# holds no point"])


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
