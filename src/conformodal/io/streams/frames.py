"""One frame of a stream, and what a stream is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from conformodal.core.arrays import UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.io.errors import DatasetError
from conformodal.io.reading import Note


class SourceError(DatasetError):
    """A source that cannot be opened, or that ends where it should not; what came before it is sound."""


def check_size(place: str, size: tuple[int, int] | None, camera: PinholeCamera | None) -> None:
    """Refuse images of another size than the camera's that a source without calibration is assumed to have."""
    if size and camera is not None and size != (camera.width, camera.height):
        raise SourceError(
            f"{place}: has images of {size[0]}x{size[1]} pixels and no calibration; expected the model's "
            f"{camera.width}x{camera.height}. Give its camera by data convert --camera, and run what that writes"
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as a camera delivers it.

    Attributes
    ----------
    name
        For people and for results.
    timestamp_s
        Seconds.
    image
        (height, width, 3) RGB, or None where it could not be had; `problem` says why.
    recording
        Number of its recording: motion is never linked across them.
    answer
        False for a frame that only leads from one to the next and wants no answer.
    index
        Its place in a data set, -1 elsewhere.
    """

    name: str
    timestamp_s: float
    image: UInt8Array | None
    problem: str = ""
    recording: int = 0
    answer: bool = True
    index: int = -1


class FrameStream(Protocol):
    """Frames in order of time.

    Iterating decodes one after the other, closes at its end what it holds open, and raises :class:`SourceError` where
    the source breaks off.
    """

    @property
    def name(self) -> str:
        """For people."""

    @property
    def camera(self) -> PinholeCamera | None:
        """Intrinsics, where the source knows them."""

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is unlikely, left out or assumed."""

    @property
    def n_frames(self) -> int | None:
        """Frames to come, or None where nobody knows."""

    @property
    def live(self) -> bool:
        """Whether frames that are not taken in time are lost."""

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame."""
