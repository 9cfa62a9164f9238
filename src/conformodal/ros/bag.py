"""A run as an MCAP file with ROS 2 messages, written through rosbags (extra ``ros``); no ROS is needed."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Self

import cv2

from conformodal.core.extras import require_extra
from conformodal.geometry import Trajectory
from conformodal.io.streams.frames import Frame
from conformodal.pipeline.estimates import Estimate

from .conversion import CAMERA_FRAME, IMAGE, NAMESPACE, TOPICS, TRUTH, Conversion, nanoseconds

_VERSION = 8  # of the format: Humble reads it too
_JPEG_QUALITY = 80


class BagWriter:
    """Writes one MCAP file with the messages of every frame of a run.

    ROS and Foxglove play an MCAP file by itself, without the rest of the folder that a ROS 2 bag is. It is written to a
    temporary folder beside its place `path`, and moved there when the context ends. With `images`, images are written
    too, as JPEG.
    """

    def __init__(self, path: Path, *, images: bool = False) -> None:
        with require_extra("ros", "a recording of ROS messages"):
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: PLC0415
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
        self.path, self._images = path, images
        self._conversion = Conversion()
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._recording: int | None = None
        self._last_ns: int | None = None
        self._types = {**TOPICS, **TRUTH, **(IMAGE if images else {})}
        path.parent.mkdir(parents=True, exist_ok=True)
        self._scratch = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
        self._folder = Path(self._scratch.name) / "bag"
        self._writer: Any = Writer(self._folder, version=_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections = {
            name: self._writer.add_connection(f"{NAMESPACE}/{name}", kind, typestore=self._store)
            for name, kind in self._types.items()
        }

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Write a frame and its estimate; `truth` is a trajectory of one pose, or None."""
        conversion = self._conversion
        if frame.recording != self._recording:
            self._write_path()
            conversion.reset()
            self._recording = frame.recording
        stamp_ns = nanoseconds(estimate.timestamp_s)
        messages = conversion.messages(estimate, stamp_ns)
        if truth is not None:
            messages["truth"] = conversion.stamped(stamp_ns, conversion.poses(truth)[0])
        if self._images and frame.image is not None:
            bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].ravel()
            ((name, kind),) = IMAGE.items()
            header = conversion.header(stamp_ns, CAMERA_FRAME)
            messages[name] = conversion.make(kind, header=header, format="jpeg", data=data)
        self._last_ns = stamp_ns
        for name, message in messages.items():
            self._write(name, message)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Write the last path, and move the file to its place.

        Without a single frame, or after an error, no file is written, and an existing one stays.
        """
        try:
            if error is None:
                self._write_path()
                self._writer.close()
                for written in self._folder.glob("*.mcap") if self._last_ns is not None else ():
                    written.replace(self.path)
        finally:
            self._writer.abort()
            self._scratch.cleanup()

    def _write_path(self) -> None:
        if self._last_ns is not None:
            self._write("path", self._conversion.path(self._last_ns))

    def _write(self, name: str, message: Any) -> None:
        data = self._store.serialize_cdr(message, self._types[name])
        self._writer.write(self._connections[name], self._last_ns, data)
