"""A run as an MCAP file with ROS 2 messages, written through rosbags (extra ``ros``); no ROS is needed."""

from __future__ import annotations

import tempfile
from array import array
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from conformodal.core.extras import require_extra
from conformodal.datasets.streams.frames import Frame
from conformodal.poses import Trajectory
from conformodal.running.estimates import Estimate

from . import messages as ros
from .conventions import IMAGE, TOPICS, TRUTH, Conventions
from .conversion import Conversion
from .errors import RosError
from .foreign_messages import build

_VERSION = 8  # of the format: Humble reads it too
_JPEG_QUALITY = 80


class BagWriter:
    """Writes one MCAP file with the messages of every frame of a run.

    A bag of ROS 2 is a folder with a list of its contents; ROS and Foxglove also play the MCAP file in it by itself,
    and that is what is kept. It is written in a folder beside its place, and moved there by :meth:`close`.

    Parameters
    ----------
    path
        Of the file, ``.mcap``; one that is there is replaced.
    how
        Names and limits.
    images
        Write every frame's image too, as JPEG.

    Raises
    ------
    MissingPackageError
        If rosbags is not installed.
    RosError
        If the file cannot be written.
    """

    def __init__(self, path: Path, how: Conventions | None = None, *, images: bool = False) -> None:
        with require_extra("ros", "a recording of ROS messages"):
            from rosbags.rosbag2 import (  # noqa: PLC0415 - an extra
                CompressionFormat,
                CompressionMode,
                StoragePlugin,
                Writer,
            )
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
        self.path, self.how = path, how or Conventions()
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._conversion = Conversion(self.how)
        self._recording: int | None = None
        self._last_ns: int | None = None
        self._images = images
        self._closed = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # of a killed run it stays; else it goes at the end, whoever forgets to close
            self._apart = tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent)
            self._folder = Path(self._apart.name) / "bag"
            self._writer: Any = Writer(self._folder, version=_VERSION, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except OSError as exc:
            raise RosError(f"{path}: cannot be written: {exc}") from exc
        types = {**TOPICS, **TRUTH, **(IMAGE if images else {})}
        self._connections = {
            name: self._writer.add_connection(self.how.topic(name), kind.TYPE, typestore=self._store)
            for name, kind in types.items()
        }

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Write a frame and what was made of it; `truth` is a trajectory of one, or None.

        Raises
        ------
        RosError
            If ROS has no such time, or the file cannot be written.
        """
        if frame.recording != self._recording:
            self._write_path()
            self._conversion.reset()
            self._recording = frame.recording
        stamp_ns = ros.nanoseconds(estimate.timestamp_s)
        found = self._conversion.messages(estimate, stamp_ns)
        header = ros.Header(ros.Time.of(stamp_ns), self.how.world_frame)
        if truth is not None:
            pose = ros.Pose.of(truth.positions_xyz[0], truth.orientations_quat_wxyz[0])
            found["truth"] = ros.PoseStamped(header, pose)
        if self._images and frame.image is not None:
            _, data = cv2.imencode(
                ".jpg", cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            )
            seen = ros.Header(header.stamp, self.how.camera_frame)
            found["image/compressed"] = ros.CompressedImage(seen, "jpeg", array("B", data.tobytes()))
        self._last_ns = stamp_ns
        for name, message in found.items():
            self._write(name, message, stamp_ns)

    def close(self) -> None:
        """Write the last path, and put the file in its place; what a run that was stopped has said is kept.

        Without a single frame there is no file, and one that was there stays.

        Raises
        ------
        RosError
            If the file cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._write_path()
            self._writer.close()
            if self._last_ns is not None:
                (written,) = self._folder.glob("*.mcap")
                written.replace(self.path)
        except OSError as exc:
            raise RosError(f"{self.path}: cannot be written: {exc}") from exc
        finally:
            self._writer.abort()
            self._apart.cleanup()

    def _write_path(self) -> None:
        if self._last_ns is not None:
            self._write("path", self._conversion.path(self._last_ns), self._last_ns)

    def _write(self, name: str, message: ros.RosMessage, stamp_ns: int) -> None:
        made = build(message, self._store.types.__getitem__, np.asarray)
        data = self._store.serialize_cdr(made, message.TYPE)
        try:
            self._writer.write(self._connections[name], stamp_ns, data)
        except OSError as exc:
            raise RosError(f"{self.path}: cannot be written: {exc}") from exc
