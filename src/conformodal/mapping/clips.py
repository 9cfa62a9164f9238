"""Videos and folders of images as frames on disk, of which some are keyframes."""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from conformodal.core.arrays import FloatArray, IntArray, evenly_spread
from conformodal.core.progress import Progress
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import OF_LAYOUT, camera_beside
from conformodal.io.decoding import common_size, is_turned
from conformodal.io.errors import DatasetError, DatasetWarning
from conformodal.io.frame_table import OWN_SCALE
from conformodal.io.layouts.images import read_image_folder
from conformodal.io.reading import BETWEEN_RECORDINGS_S, Note
from conformodal.io.registry import Layout, readers, recognise
from conformodal.io.streams import open_stream
from conformodal.io.streams.bag import is_bag
from conformodal.io.streams.frames import Frame, FrameStream, RecordingStream, SourceError, prefetch

from .keyframes import KeyframePicker
from .settings import MapError, MapSettings

_FOCAL_SHARE = 1.2  # of the longer side, where nothing says the focal length
_COPIED = ("JPEG", "PNG")  # formats that both pycolmap and the readers take
_COPIED_AS = (".jpg", ".jpeg", ".png")
_UNUSED = (OF_LAYOUT, OWN_SCALE)  # notes on a camera and poses that are not used
NO_IMAGE, BACK = "left out, no image of the camera's size", "left out, time goes back"


class Source(NamedTuple):
    """Where frames come from: their stream, the camera if it is known, and what is unlikely about it."""

    path: Path
    stream: FrameStream
    camera: PinholeCamera | None
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames of one recording of a camera, in order of time.

    Attributes
    ----------
    name
        Its folder; files are named ``NAME/000000.jpg`` and so on.
    source
        What a user calls it.
    images
        Files of the frames, relative to the folder of all clips.
    source_names
        What each frame is called where it comes from.
    times_s
        (n,) seconds.
    size
        Width and height, pixels.
    camera
        Its intrinsics where they are known.
    keyframes
        (k,) places of the keyframes.
    notes
        What was left out, and what is unlikely or assumed of its source.
    """

    name: str
    source: str
    images: tuple[str, ...]
    source_names: tuple[str, ...]
    times_s: FloatArray
    size: tuple[int, int]
    camera: PinholeCamera | None
    keyframes: IntArray
    notes: tuple[Note, ...] = ()

    def __len__(self) -> int:
        return len(self.images)

    @property
    def keyframe_images(self) -> list[str]:
        """Files of the keyframes."""
        return [self.images[k] for k in self.keyframes.tolist()]


def open_sources(paths: Sequence[Path], camera_file: Path | None = None) -> list[Source]:
    """Open videos, ROS recordings, data sets and folders of images; poses in them are not used.

    The camera of a file is that of all sources; a source that knows another one is refused.
    """
    resolved = [path.resolve() for path in paths]
    if twice := next((path for path in resolved if resolved.count(path) > 1), None):
        raise MapError(f"{twice}: is given twice, expected each video once")
    sources = [_open_folder(path) if path.is_dir() and not is_bag(path) else _open_video(path) for path in paths]
    return sources if camera_file is None else [_with_camera(source, camera_file) for source in sources]


def _open_video(path: Path) -> Source:
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder, expected a video or a folder of images")
    stream = open_stream(path)
    return Source(path, stream, stream.camera)


def _open_folder(folder: Path) -> Source:
    """Images of a folder, in a layout that is read or without one."""
    try:
        layout = recognise(folder)
    except DatasetError:
        layout = Layout.IMAGES
    table = read_image_folder(folder.resolve()) if layout == Layout.IMAGES else readers()[layout].read(folder.resolve())
    # a camera that only the layout tells is fitted: it may not be that of these images
    known = table.camera is not None and all(note.what != OF_LAYOUT for note in table.notes)
    if not known:
        table.camera = _usual_camera(*common_size(table.images))
    table.poses, table.source = None, folder
    table.notes = [note for note in table.notes if note.what not in _UNUSED]
    with warnings.catch_warnings():  # frames that are left out are told later
        warnings.simplefilter("ignore", DatasetWarning)
        recording = table.to_recording(require_poses=False)
    return Source(folder, RecordingStream(recording), recording.camera if known else None)


def _usual_camera(width: int, height: int) -> PinholeCamera:
    """A camera to read images with until theirs is fitted."""
    focal = _FOCAL_SHARE * max(width, height)
    return PinholeCamera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _with_camera(source: Source, file: Path) -> Source:
    """A source with the camera of a file, which is scaled to no other size."""
    if source.camera is not None:
        found = f"has a camera, fx = {source.camera.fx:g}, and --camera gives one"
        raise MapError(f"{source.path}: {found}; leave out --camera")
    first = next((frame.image for frame in source.stream if frame.image is not None), None)
    if first is None:
        raise SourceError(f"{source.path}: holds no frame that can be used")
    notes = list[Note]()
    camera = camera_beside(file, (first.shape[1], first.shape[0]), None, notes)
    if camera is None:
        raise MapError(f"{file}: no camera-intrinsics.txt there, expected one with the 3x3 matrix of the camera")
    return source._replace(camera=camera, notes=tuple(notes))


def write_clips(
    sources: Sequence[Source], images: Path, settings: MapSettings, progress: Progress | None = None
) -> list[Clip]:
    """Write all frames under a folder, and pick keyframes on the way. Refuses sources without a frame."""
    clips, done = list[Clip](), 0
    counts = [source.stream.n_frames for source in sources]
    total = sum(count or 0 for count in counts)
    for source in sources:
        writers: dict[int, _ClipWriter] = {}
        for frame in prefetch(source.stream):
            if frame.recording not in writers:
                name = _folder_name(source.path, len(clips) + len(writers) + 1)
                writers[frame.recording] = _ClipWriter(name, images, source, settings)
            writers[frame.recording].add(frame)
            done += 1
            if progress is not None:
                progress(done, max(total, done))
        own = [writer.finish() for writer in writers.values()]
        if len(own) > 1:
            own = [replace(clip, source=f"{clip.source}, recording {k}") for k, clip in enumerate(own, start=1)]
        if own:
            own[0] = replace(own[0], notes=(*source.stream.notes, *source.notes, *own[0].notes))
        clips += own
    return _at_most(_in_order(clips), settings.max_keyframes)


def _in_order(clips: Sequence[Clip]) -> list[Clip]:
    """Clips with times of which each begins after the end of the one before."""
    moved, end_s = list[Clip](), -np.inf
    for clip in clips:
        begin_s = float(clip.times_s[0])
        shift_s = 0.0 if begin_s > end_s else end_s + BETWEEN_RECORDINGS_S - begin_s
        moved.append(replace(clip, times_s=clip.times_s + shift_s))
        end_s = float(moved[-1].times_s[-1])
    return moved


def _at_most(clips: list[Clip], n: int) -> list[Clip]:
    """Clips with so many keyframes in all, evenly spread over those that were picked."""
    kept = evenly_spread(sum(len(clip.keyframes) for clip in clips), n)
    parts, start = list[Clip](), 0
    for clip in clips:
        end = start + len(clip.keyframes)
        own = kept[(kept >= start) & (kept < end)] - start
        parts.append(replace(clip, keyframes=clip.keyframes[own]))
        start = end
    return parts


def _folder_name(path: Path, number: int) -> str:
    """A name of letters, digits and few signs; by their numbers, folders are read in the order of the clips."""
    return f"{number}-{re.sub(r'[^A-Za-z0-9_-]+', '-', path.resolve().stem).strip('-')}".rstrip("-")


def _is_copied(path: Path) -> bool:
    """Whether an image is stored as it is shown, in a format that is copied; its suffix may tell another one."""
    with Image.open(path) as image:
        return image.format in _COPIED and not is_turned(path)


class _ClipWriter:
    """Writes the frames of one clip."""

    def __init__(self, name: str, folder: Path, source: Source, settings: MapSettings) -> None:
        self.name, self.folder, self.source, self.settings = name, folder, source, settings
        self.images: list[str] = []
        self.source_names: list[str] = []
        self.times_s: list[float] = []
        self.notes: list[Note] = []
        self.size: tuple[int, int] | None = None
        self.picker = KeyframePicker(settings.keyframe_flow_px)
        (folder / name).mkdir(parents=True)

    def add(self, frame: Frame) -> None:
        """Write a frame, or note why it is left out."""
        if frame.image is None:
            self.notes.append(Note(NO_IMAGE, frame.problem or frame.name))
            return
        size = frame.image.shape[1], frame.image.shape[0]
        self.size = self.size or size
        camera = self.source.camera
        if camera is not None and size != (camera.width, camera.height):
            found = f"images of {size[0]}x{size[1]} pixels, and the camera's are {camera.width}x{camera.height}"
            raise MapError(f"{self.source.path}: has {found}; give the camera of these images")
        if size != self.size:
            self.notes.append(Note(NO_IMAGE, f"{frame.name}: is {size[0]}x{size[1]} pixels"))
        elif not frame.timestamp_s > (self.times_s[-1] if self.times_s else -np.inf):
            self.notes.append(Note(BACK, frame.name))
        else:
            self.picker.add(len(self.images), frame.image)
            self.images.append(f"{self.name}/{self._write(frame).name}")
            self.source_names.append(frame.name)
            self.times_s.append(frame.timestamp_s)

    def _write(self, frame: Frame) -> Path:
        """Copy the image of a folder, or write that of another source with hardly a loss."""
        stem = self.folder / self.name / f"{len(self.images):06d}"
        stream = self.source.stream
        original = stream.sequence.image_paths[frame.index] if isinstance(stream, RecordingStream) else Path()
        if original.suffix.lower() in _COPIED_AS and _is_copied(original):
            return Path(shutil.copyfile(original, stem.with_suffix(original.suffix.lower())))
        path = stem.with_suffix(".jpg")
        Image.fromarray(np.asarray(frame.image)).save(path, quality=self.settings.jpeg_quality, subsampling=0)
        return path

    def finish(self) -> Clip:
        """The clip, which has at least one frame."""
        if not self.images or self.size is None:
            why = f": {self.notes[0].where}" if self.notes else ""
            raise SourceError(f"{self.source.path}: holds no frame that can be used{why}")
        return Clip(
            name=self.name,
            source=str(self.source.path),
            images=tuple(self.images),
            source_names=tuple(self.source_names),
            times_s=np.array(self.times_s),
            size=self.size,
            camera=self.source.camera,
            keyframes=np.array(self.picker.finish(), dtype=np.int64),
            notes=tuple(self.notes),
        )
