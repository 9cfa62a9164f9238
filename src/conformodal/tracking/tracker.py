"""Harris corners followed by pyramidal Lucas-Kanade flow (the paper, section 3)."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, IntArray, UInt8Array

_MAX_CORNERS = 500  # tracked at a time
_RENEW_BELOW = 0.85  # share of these below which new corners are detected
_HARRIS_K = 0.04  # weight of the squared trace in the Harris response
_QUALITY = 1e-4  # weakest Harris response, relative to the strongest
_SPACING = 0.025  # least distance between new corners, as a share of the image width
_WINDOW_PX = 11  # of Lucas-Kanade flow
# pyramid levels above the image; and for tracking back, which starts from the corner's first position
_LEVELS, _BACK_LEVELS = 4, 1
_MAX_BACK_ERROR_PX = 0.7  # largest distance between a corner and itself tracked forth and back
_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


class Corners(NamedTuple):
    """The corners of one frame."""

    ids: IntArray  # (n,) a corner keeps its number in all frames; none is reused
    pixels: Float32Array  # (n, 2)


class CornerTracker:
    """Follows corners from a marked frame through the frames after it.

    Call :meth:`mark` on a frame to start from, then :meth:`advance` with every later frame; :meth:`pairs` gives the
    marked and current positions of the corners that lived all the way.

    Attributes
    ----------
    step
        Pixels (n, 2) of the corners in the frame before the current one, and the same corners in this one.
    n_at_mark
        Corners at the marked frame.
    """

    step: tuple[Float32Array, Float32Array]

    def __init__(self) -> None:
        self._n_ever = 0
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a cut."""
        self._image: UInt8Array | None = None
        self._now: Float32Array = np.empty((0, 2), np.float32)
        self._marked: Float32Array = np.empty((0, 2), np.float32)
        self._ids: IntArray = np.empty(0, np.int64)
        self.step = self._now, self._now
        self.n_at_mark = 0

    @property
    def started(self) -> bool:
        """Whether a frame has been seen."""
        return self._image is not None

    def advance(self, image: UInt8Array) -> None:
        """Follow the living corners into the next frame, and drop those that do not come back to their start."""
        previous, self._image = self._image, image
        if previous is None or len(self._now) == 0:
            self.step = self._now, self._now
            return
        options: dict[str, Any] = {"winSize": (_WINDOW_PX, _WINDOW_PX), "criteria": _UNTIL}
        start = self._now[:, None]
        there, tracked, _ = cv2.calcOpticalFlowPyrLK(previous, image, start, start.copy(), maxLevel=_LEVELS, **options)
        # tracking back may start at its end: a stable corner comes back there, a false one does not
        options |= {"maxLevel": _BACK_LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        back, tracked_back, _ = cv2.calcOpticalFlowPyrLK(image, previous, there, start.copy(), **options)
        there, back = there[:, 0], back[:, 0]
        height, width = image.shape
        alive = (tracked[:, 0] == 1) & (tracked_back[:, 0] == 1)
        alive &= np.linalg.norm(back - self._now, axis=1) <= _MAX_BACK_ERROR_PX
        alive &= (there >= 0).all(axis=1) & (there <= (width - 1, height - 1)).all(axis=1)
        self.step = self._now[alive], there[alive]
        self._now, self._marked, self._ids = there[alive], self._marked[alive], self._ids[alive]

    def mark(self) -> None:
        """Measure motion from the current frame on: renew lost corners, and note where all of them are."""
        if self._image is None:
            return
        if len(self._now) < _RENEW_BELOW * _MAX_CORNERS:
            new = self._new_corners(self._image, _MAX_CORNERS - len(self._now))
            self._now = np.concatenate((self._now, new))
            self._ids = np.concatenate((self._ids, self._n_ever + np.arange(len(new))))
            self._n_ever += len(new)
        self._marked = self._now.copy()
        self.n_at_mark = len(self._now)

    def pairs(self) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) at the marked frame and at the current one."""
        return self._marked.astype(np.float64), self._now.astype(np.float64)

    def corners(self) -> Corners:
        """All living corners of the current frame."""
        return Corners(self._ids.copy(), self._now.copy())

    def _new_corners(self, image: UInt8Array, count: int) -> Float32Array:
        spacing = max(3.0, _SPACING * image.shape[1])
        free = np.full(image.shape, 255, np.uint8)
        for x, y in self._now:
            cv2.circle(free, (round(float(x)), round(float(y))), round(spacing), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image, count, _QUALITY, spacing, mask=free, useHarrisDetector=True, k=_HARRIS_K
        )
        return np.empty((0, 2), np.float32) if corners is None else np.asarray(corners, np.float32).reshape(-1, 2)
