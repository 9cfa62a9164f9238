"""A data set as a stream that ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from conformodal.core.arrays import IntArray
from conformodal.geometry import PinholeCamera
from conformodal.io.errors import ImageError
from conformodal.io.reading import Note
from conformodal.io.recording import Recording

from .frames import Frame


@dataclass(frozen=True, eq=False)
class RecordingStream:
    """Frames of a data set.

    Attributes
    ----------
    sequence
        The data set.
    frames
        Increasing indices of those that want an answer, all by default. The frames between them come too, for the
        tracker.
    """

    sequence: Recording
    frames: IntArray | None = None
    live = False

    @property
    def name(self) -> str:
        """The data set's."""
        return self.sequence.name

    @property
    def camera(self) -> PinholeCamera:
        """The data set's."""
        return self.sequence.camera

    @property
    def notes(self) -> tuple[Note, ...]:
        """The data set's."""
        return self.sequence.notes

    @property
    def n_frames(self) -> int:
        """Frames to come, those between included."""
        return len(self._span())

    def _span(self) -> range:
        if self.frames is None:
            return range(len(self.sequence))
        return range(int(self.frames.min()), int(self.frames.max()) + 1) if self.frames.size else range(0)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; one that cannot be decoded comes without an image."""
        wanted = set(self._span() if self.frames is None else self.frames.tolist())
        for i in self._span():
            image, problem = None, ""
            try:
                image = self.sequence.image(i)
            except ImageError as exc:
                problem = str(exc)
            name, time_s = self.sequence.image_paths[i].name, float(self.sequence.timestamps_s[i])
            yield Frame(name, time_s, image, problem, int(self.sequence.recording[i]), i in wanted, i)
