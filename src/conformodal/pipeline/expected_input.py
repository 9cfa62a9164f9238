"""What times and colours a model expects of a stream, from those of its training data."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray, UInt8Array, evenly_spread
from conformodal.io import Recording

from .config import OdometryError

_FIRST = 10  # frames of a stream that are looked at
_SAMPLED = 64  # training images
_COLOURS = 21  # bins of red less blue, as a share of their sum with green
_MUCH_LONGER = 300.0  # times as long a step is in another unit than seconds
_SWAPPED = 0.2  # by how much the colours fit better with red and blue swapped


@dataclass(frozen=True, eq=False)
class ExpectedInput:
    """The usual step in time of training frames, and the distribution of their colours."""

    step_s: float
    colours: FloatArray  # (21,) shares of pixels by red less blue, sum 1

    @classmethod
    def of(cls, recording: Recording) -> ExpectedInput:
        """From all times, and some images."""
        steps = np.diff(recording.timestamps_s)[np.diff(recording.recording) == 0]
        sampled = evenly_spread(len(recording), _SAMPLED).tolist()
        colours = np.mean([_colours_of(recording.image(i)) for i in sampled], axis=0)
        return cls(float(np.median(steps)) if steps.size else 1.0, colours)


class InputWatch:
    """Looks at the first frames of a stream, whether its times are in seconds and its images RGB."""

    def __init__(self, expected: ExpectedInput) -> None:
        self._expected = expected
        self._steps: list[float] = []
        self._colours: list[FloatArray] = []

    def check_step(self, step_s: float) -> None:
        """Refuse, once the first steps are there, times that are in another unit."""
        if len(self._steps) >= _FIRST:
            return
        self._steps.append(step_s)
        usual = float(np.median(self._steps))
        if len(self._steps) == _FIRST and usual > _MUCH_LONGER * self._expected.step_s:
            self._steps.pop()  # so that the next step is looked at as well
            raise OdometryError(
                f"timestamps must be in seconds: the first {_FIRST} steps are usually {usual:.3g} long, those of the "
                f"training data {self._expected.step_s:.3g} s; are they in milliseconds or nanoseconds?"
            )

    def check_colours(self, image: UInt8Array) -> None:
        """Warn, once, of images (h, w, 3) whose red and blue are swapped."""
        if len(self._colours) >= _FIRST:
            return
        self._colours.append(_colours_of(image))
        if len(self._colours) < _FIRST:
            return
        mean, expected = np.mean(self._colours, axis=0), self._expected.colours
        as_given, swapped = (float(np.minimum(colours, expected).sum()) for colours in (mean, mean[::-1]))
        if swapped > as_given + _SWAPPED:
            warnings.warn(
                f"images seem to be BGR: their colours agree with those of the training data to "
                f"{100 * as_given:.0f} %, with red and blue swapped to {100 * swapped:.0f} %; pass RGB",
                UserWarning,
                stacklevel=5,
            )


def _colours_of(image: UInt8Array) -> FloatArray:
    small = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).reshape(-1, 3).astype(np.float64)
    red_less_blue = (small[:, 0] - small[:, 2]) / np.maximum(small.sum(axis=1), 1.0)
    counts = np.histogram(red_less_blue, bins=_COLOURS, range=(-0.5, 0.5))[0]
    return np.asarray(counts / len(small))
