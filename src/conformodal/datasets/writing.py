"""Writing a source in another layout."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.core.arrays import FloatArray
from conformodal.core.choices import as_member
from conformodal.core.words import counted
from conformodal.datasets.streams.frames import Frame, FrameStream
from conformodal.datasets.streams.stored import SequenceStream
from conformodal.poses import PinholeCamera, PoseError, Trajectory, associate
from conformodal.poses.metrics import nearest_in_time

from .errors import DatasetError
from .layout_files import FINISH, WrittenFrames, finish_colmap_binary
from .layouts import Layout
from .reading import MAX_TIME_DIFFERENCE_S
from .staging import staged

# Where images go, and how they are named: by number, or time in seconds.
_PLACES: dict[Layout, tuple[str, str]] = {
    Layout.SEVENSCENES: ("", "frame-{number:06d}.color"),
    Layout.TUM: ("rgb", "{time_s:.6f}"),
    Layout.IMAGES: ("", "{number:06d}"),
    Layout.COLMAP: ("images", "{number:06d}"),
}
WRITABLE = tuple(_PLACES)
# Readers pair frames with poses by time in these: a frame without one would be lent a pose that is near enough.
_PAIRED_BY_TIME = (Layout.TUM, Layout.IMAGES)
_ROUNDED_S = 2e-6
_MOST_NAMES = 20
_NO_IMAGE, _NO_TIME, _NO_POSE, _LENT = (
    "without an image",
    "whose time goes back",
    "without a pose",
    "without a pose, so near to others in time that they would be read back with theirs",
)
_NOWHERE = (float("nan"),) * 7


@dataclass
class ConversionReport:
    """What was written, and what was not; the notes name the frames.

    Attributes
    ----------
    n_frames, n_posed
        Written, and how many of them with a pose.
    n_unreadable, n_without_pose, n_without_time
        Left out.
    notes
        For people.
    """

    n_frames: int = 0
    n_posed: int = 0
    n_unreadable: int = 0
    n_without_pose: int = 0
    n_without_time: int = 0
    notes: list[str] = field(default_factory=list)


def write_layout(
    folder: Path,
    layout: Layout | str,
    stream: FrameStream,
    camera: PinholeCamera,
    poses: Trajectory | None,
    progress: Callable[[int], None] | None = None,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
    *,
    binary: bool = False,
) -> ConversionReport:
    """Write the frames of a source, one after the other; images that lie in files are copied as they are.

    They are written beside the folder and moved into its place at the end: a failure leaves nothing there.

    Parameters
    ----------
    folder
        New or empty.
    layout
        One of :data:`WRITABLE`.
    stream
        Of one recording; ``7scenes`` holds several.
    camera
        Intrinsics.
    poses
        Of the frames, paired by time. Frames without one are kept without. None writes no poses.
    progress
        Called with frames done.
    max_difference_s
        Between a frame and its pose; 0 for poses with the frames' own times.
    binary
        Whether a COLMAP model is written in binary files instead of text.

    Raises
    ------
    DatasetError
        If the folder holds something, the layout cannot be written or cannot hold several recordings or no poses, a
        name would be used twice, or nothing is left to write.
    """
    layout = as_member(layout, Layout, "layout", DatasetError)
    if layout not in _PLACES:
        raise DatasetError(f"layout {layout} is read only; can be written: {', '.join(WRITABLE)}")
    if binary and layout is not Layout.COLMAP:
        raise DatasetError(f"{layout} has no binary files; only a COLMAP model has")
    if poses is None and layout is Layout.COLMAP:
        raise DatasetError(f"{layout} needs poses")
    if isinstance(stream, SequenceStream):
        _check(stream, layout, poses, max_difference_s)
    with staged(folder) as part:
        kept = _Kept(part, layout, stream, camera, poses, max_difference_s)
        for number, frame in enumerate(stream, start=1):
            kept.take(frame)
            if progress is not None:
                progress(number)
        return kept.finish(binary=binary)


def _check(stream: SequenceStream, layout: Layout, poses: Trajectory | None, max_difference_s: float) -> None:
    """Refuse what is known before the first frame is read."""
    times = stream.sequence.timestamps_s
    if _several(stream) and layout is not Layout.SEVENSCENES:
        raise DatasetError(
            f"{stream.name}: holds several recordings, and {layout} has a place for one; write 7scenes, or convert one "
            "at a time"
        )
    if poses is not None:
        asked = Trajectory(times, np.zeros((len(times), 3)), np.tile([1.0, 0, 0, 0], (len(times), 1)))
        try:
            associate(asked, poses, max_difference_s)
        except PoseError as exc:
            raise DatasetError(f"{stream.name}: no frame has a pose: {exc}") from exc


def _several(stream: FrameStream) -> bool:
    return isinstance(stream, SequenceStream) and len(np.unique(stream.sequence.recording)) > 1


class _Kept:
    """Frames as they are written; see :func:`write_layout` for the parameters."""

    def __init__(
        self,
        folder: Path,
        layout: Layout,
        stream: FrameStream,
        camera: PinholeCamera,
        poses: Trajectory | None,
        max_difference_s: float,
    ) -> None:
        self.folder, self.layout, self.stream, self.camera = folder, layout, stream, camera
        # in the order of time once, so that the pose of a frame is found without a look at all of them
        self.truth = None if poses is None else poses[np.argsort(poses.timestamps_s, kind="stable")]
        self.max_difference_s = max_difference_s
        self.place, self.pattern = folder / _PLACES[layout][0], _PLACES[layout][1]
        self.place.mkdir(parents=True, exist_ok=True)
        self.several = _several(stream)
        self.sources: list[str] = []  # names of the frames where they come from
        self.names: list[str] = []
        self.times: list[float] = []
        self.recording: list[int] = []
        self.counts: Counter[int] = Counter()  # frames by recording
        self.poses: list[tuple[float, ...]] = []
        self.left: dict[str, list[str]] = {why: [] for why in (_NO_IMAGE, _NO_TIME, _LENT)}

    def take(self, frame: Frame) -> None:
        """Write a frame's image, or take up why it is left out."""
        if not self.several and self.recording and frame.recording != self.recording[-1]:
            raise DatasetError(f"{self.stream.name}: holds several recordings; convert one at a time")
        pose = None if self.truth is None else _pose(self.truth, frame.timestamp_s, self.max_difference_s)
        if frame.image is None or frame.image.shape[:2] != (self.camera.height, self.camera.width):
            self.left[_NO_IMAGE].append(frame.name)
        elif not np.isfinite(frame.timestamp_s) or (self.times and frame.timestamp_s <= self.times[-1]):
            self.left[_NO_TIME].append(frame.name)
        else:
            self.names.append(self._image(frame))
            self.sources.append(frame.name)
            self.times.append(frame.timestamp_s)
            self.recording.append(frame.recording)
            self.counts[frame.recording] += 1
            self.poses.append(_NOWHERE if pose is None else pose)

    def _image(self, frame: Frame) -> str:
        number, place = self.counts[frame.recording], self.place
        if self.several:
            place = place / f"seq-{frame.recording + 1:02d}"
            place.mkdir(exist_ok=True)
        stem = self.pattern.format(number=number, time_s=frame.timestamp_s)
        stream = self.stream
        source = stream.sequence.image_paths[frame.index] if isinstance(stream, SequenceStream) else None
        suffix = source.suffix if source is not None and source.suffix in (".png", ".jpg") else ".png"
        target = place / f"{stem}{suffix}"
        if target.exists():
            raise DatasetError(f"{target}: two frames have this name")
        if source is not None and source.suffix == suffix:
            shutil.copyfile(source, target)
        else:
            Image.fromarray(np.asarray(frame.image)).save(target)
        return str(target.relative_to(self.place))

    def finish(self, *, binary: bool) -> ConversionReport:
        """Write everything but the images."""
        poses = np.array(self.poses).reshape(-1, 7)
        posed = np.isfinite(poses).all(axis=1)
        done = ConversionReport(
            n_unreadable=len(self.left[_NO_IMAGE]),
            n_without_time=len(self.left[_NO_TIME]),
        )
        if not self.names or (self.truth is not None and not posed.any()):
            raise DatasetError(
                f"{self.stream.name}: nothing to write: {done.n_unreadable} unreadable, no pose for the rest"
            )
        kept = np.flatnonzero(~self._lent(posed)) if self.truth is not None else np.arange(len(posed))
        for i in np.setdiff1d(np.arange(len(posed)), kept).tolist():
            (self.place / self.names[i]).unlink()
            self.left[_LENT].append(self.sources[i])
        frames = WrittenFrames(
            [self.names[i] for i in kept],
            np.array(self.times)[kept],
            np.array(self.recording)[kept],
            None if self.truth is None else poses[kept],
        )
        write = finish_colmap_binary if binary else FINISH[self.layout]
        lost = write(self.folder, frames, self.camera)
        done.n_frames, done.n_posed = len(kept), int(posed[kept].sum())
        done.n_without_pose = len(self.left[_LENT])
        done.notes = [f"left out {_listed(names, why)}" for why, names in self.left.items() if names]
        without = [self.sources[i] for i in kept if not posed[i]]
        if self.truth is not None and without:
            done.notes.append(f"kept {_listed(without, _NO_POSE)}")
        done.notes += lost
        return done

    def _lent(self, posed: np.ndarray) -> np.ndarray:
        """Which frames without a pose would be read back with another frame's."""
        lent = np.zeros(len(posed), dtype=np.bool_)
        if self.layout in _PAIRED_BY_TIME:
            times: FloatArray = np.array(self.times)
            near = times[posed]
            after = np.clip(np.searchsorted(near, times), 0, len(near) - 1)
            before = np.maximum(after - 1, 0)
            away = np.minimum(np.abs(near[after] - times), np.abs(near[before] - times))
            lent = ~posed & (away <= MAX_TIME_DIFFERENCE_S + _ROUNDED_S)
        return lent


def _listed(frames: list[str], why: str) -> str:
    more = f" and {len(frames) - _MOST_NAMES} more" if len(frames) > _MOST_NAMES else ""
    return f"{counted(len(frames), 'frame')} {why}: {', '.join(frames[:_MOST_NAMES])}{more}"


def _pose(poses: Trajectory, time_s: float, max_difference_s: float) -> tuple[float, ...] | None:
    """The pose nearest in time, ``x y z qw qx qy qz``, or None; `poses` increase in time."""
    if not len(poses) or not np.isfinite(time_s):
        return None
    at = int(nearest_in_time(poses.timestamps_s, np.array([time_s]))[0])
    if abs(poses.timestamps_s[at] - time_s) > max_difference_s:
        return None
    return (*poses.positions_xyz[at].tolist(), *poses.orientations_quat_wxyz[at].tolist())
