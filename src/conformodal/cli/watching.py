"""Live views and recordings of a run: Rerun in a window or as a file, and files of ROS messages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

from conformodal.datasets.streams.frames import Frame
from conformodal.poses import Trajectory
from conformodal.report.live import LiveView
from conformodal.ros.bag import BagWriter
from conformodal.running.estimates import Estimate

from .options import ROS_SUFFIX


class FrameSink(Protocol):
    """Receives every frame with its estimate."""

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Take a frame; `truth` is a trajectory of one, or None."""
        ...

    def close(self) -> None:
        """Finish writing."""
        ...


@contextmanager
def frame_sinks(
    name: str, alpha: object, *, view: bool, save: Path | None, images: bool
) -> Iterator[tuple[FrameSink, ...]]:
    """The views and recordings that the options of a run ask for; all are closed at the end."""
    ros = save is not None and save.suffix.lower() == ROS_SUFFIX
    rerun = None if ros else save
    found: list[FrameSink] = []
    with ExitStack() as opened:
        if save is not None and ros:
            found.append(BagWriter(save, images=images))
            opened.callback(found[-1].close)
        if view or rerun is not None:
            found.append(LiveView(name, alpha, spawn=view, save=rerun))
            opened.callback(found[-1].close)
        yield tuple(found)
