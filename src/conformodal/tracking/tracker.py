"""From images to relative motions: Harris corners followed by pyramidal Lucas-Kanade flow (the paper, section 3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import reduce
from typing import Any, NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.geometry import MotionStatus, PinholeCamera, RelativeMotion
from conformodal.geometry.camera import NO_FLOW
from conformodal.io.decoding import grey_image

from .relative_pose import MIN_TRACKS, estimate_relative_motion, solve_opencv

_HALVED_FROM = 400  # pixels across from which corners are detected at half size: a quarter of the time, longer tracks
# corners that are tracked at a time, and the least distance between new ones, as a share of the image width: of images
# that are halved, and of smaller ones, whose corners say less each
_MAX_CORNERS, _SPACING = (320, 500), (0.034, 0.025)
# New corners are detected below this share of those after the last detection, as the image may have given no more, and
# below this share of those tracked at a time
_RENEW_BELOW, _MIN_SHARE = 0.85, 0.5
_HARRIS_K = 0.04  # weight of the squared trace in the Harris response
_QUALITY = 1e-4  # weakest Harris response, relative to the strongest
_WINDOW_PX = 11  # of Lucas-Kanade flow
# pyramid levels above the image; and for tracking back, which starts from the corner's first position
_LEVELS, _BACK_LEVELS = 4, 1
_MAX_BACK_ERROR_PX = 0.7  # largest distance between a corner and itself tracked forth and back
_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
# share of the marked corners below which rotations are chained from here on: the longest tracks drift most
_REMARK_BELOW = 0.5
_ESSENTIAL_CORNERS = 5  # that an essential matrix needs
LONGEST_FLOW_S = 0.2  # between frames: what moved before says little about now
_MIN_FLOW_CORNERS = 16
_FLOW_ITERATIONS = 6
_RIDGE, _DIAGONAL = 1e-10, np.diag_indices(3)  # corners on one line tell nothing of the flow beside it
_MIN_FLOW_PX = 0.1  # scale of the residuals, at least


class TrackedCorners(NamedTuple):
    """The corners of one frame."""

    ids: IntArray  # (n,) a corner keeps its number in all frames; none is reused
    pixels: Float32Array  # (n, 2)


class ImageCorners(NamedTuple):
    """Corners of a grey image."""

    image: UInt8Array  # (height, width)
    pixels: Float32Array  # (n, 2)


class FollowedCorners(NamedTuple):
    """Corners of one grey image in the next."""

    pixels: Float32Array  # (n, 2)
    alive: BoolArray  # (n,) whether each comes back to its start from there


def follow_corners(previous: UInt8Array, image: UInt8Array, pixels: Float32Array) -> FollowedCorners:
    """Follow pixels (n, 2), n > 0, of one grey image into the next."""
    options: dict[str, Any] = {"winSize": (_WINDOW_PX, _WINDOW_PX), "criteria": _UNTIL}
    start = pixels[:, None]
    there, tracked, _ = cv2.calcOpticalFlowPyrLK(previous, image, start, start.copy(), maxLevel=_LEVELS, **options)
    # tracking back may start at its end: a stable corner comes back there, a false one does not
    options |= {"maxLevel": _BACK_LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    back, tracked_back, _ = cv2.calcOpticalFlowPyrLK(image, previous, there, start.copy(), **options)
    there, back = there[:, 0], back[:, 0]
    height, width = image.shape
    alive = (tracked[:, 0] == 1) & (tracked_back[:, 0] == 1)
    alive &= np.linalg.norm(back - pixels, axis=1) <= _MAX_BACK_ERROR_PX
    alive &= (there >= 0).all(axis=1) & (there <= (width - 1, height - 1)).all(axis=1)
    return FollowedCorners(np.asarray(there, np.float32), np.asarray(alive, np.bool_))


class CornerTracker:
    """Follows corners from a marked frame through the frames after it.

    Call :meth:`mark` on a frame to start from, then :meth:`advance` with every later frame; :meth:`pairs` gives the
    marked and current positions of the corners that lived all the way.
    """

    # pixels (n, 2) of the corners in the frame before the current one, and the same corners in this one
    step: tuple[Float32Array, Float32Array]
    n_at_mark: int  # corners at the marked frame
    beside: FollowedCorners | None  # other corners that were followed into the current frame

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
        self.n_at_mark = self._n_renewed = 0
        self.beside = None

    @property
    def started(self) -> bool:
        """Whether a frame has been seen."""
        return self._image is not None

    def advance(self, image: UInt8Array, beside: ImageCorners | None = None) -> None:
        """Follow the living corners into the next frame, and drop those that do not come back to their start.

        Other corners of the frame before are followed `beside`: both share the images' pyramids.
        """
        previous, self._image, self.beside = self._image, image, None
        n = len(self._now)
        if previous is None or n == 0:
            self.step = self._now, self._now
            return
        if beside is None or beside.image is not previous:
            there, alive = follow_corners(previous, image, self._now)
        else:
            there, alive = follow_corners(previous, image, np.concatenate((self._now, beside.pixels)))
            self.beside = FollowedCorners(there[n:], alive[n:])
            there, alive = there[:n], alive[:n]
        self.step = self._now[alive], there[alive]
        self._now, self._marked, self._ids = there[alive], self._marked[alive], self._ids[alive]

    def mark(self) -> None:
        """Measure motion from the current frame on: renew lost corners, and note where all of them are."""
        if self._image is None:
            return
        most = _MAX_CORNERS[self._image.shape[1] < _HALVED_FROM]
        if len(self._now) < max(_RENEW_BELOW * self._n_renewed, _MIN_SHARE * most):
            new = self._new_corners(self._image, most - len(self._now))
            self._now = np.concatenate((self._now, new))
            self._ids = np.concatenate((self._ids, self._n_ever + np.arange(len(new))))
            self._n_ever += len(new)
            self._n_renewed = len(self._now)
        self._marked = self._now.copy()
        self.n_at_mark = len(self._now)

    def pairs(self) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) at the marked frame and at the current one."""
        return self._marked.astype(np.float64), self._now.astype(np.float64)

    def corners(self) -> TrackedCorners:
        """All living corners of the current frame."""
        return TrackedCorners(self._ids.copy(), self._now.copy())

    def _new_corners(self, image: UInt8Array, count: int) -> Float32Array:
        small = image.shape[1] < _HALVED_FROM
        smaller = 1 if small else 2
        image = np.asarray(cv2.resize(image, None, fx=1 / smaller, fy=1 / smaller, interpolation=cv2.INTER_AREA))
        spacing = max(3.0, _SPACING[small] * image.shape[1])
        free = np.full(image.shape, 255, np.uint8)
        for x, y in self._now / smaller:
            cv2.circle(free, (round(float(x)), round(float(y))), round(spacing), 0, -1)
        corners = cv2.goodFeaturesToTrack(
            image, count, _QUALITY, spacing, mask=free, useHarrisDetector=True, k=_HARRIS_K
        )
        corners = np.empty(0) if corners is None else corners
        # pixel centres are whole numbers, see PinholeCamera
        return np.asarray((corners.reshape(-1, 2) + 0.5) * smaller - 0.5, np.float32)


def affine_flow(step: tuple[Float32Array, Float32Array], seconds: float, camera: PinholeCamera) -> FloatArray:
    """Flow (2, 3) in pixels per second, as ``flow @ (x, y, 1)`` at an undistorted pixel, by robust least squares.

    `step` are pixels (n, 2) of the same corners `seconds` ago and now, see :attr:`CornerTracker.step`: those of the
    usable frame directly before, in training as in a run. Zero, if they are few or that is long ago.
    """
    if not 0 < seconds < LONGEST_FLOW_S or len(step[0]) < _MIN_FLOW_CORNERS:
        return NO_FLOW
    before, now = (camera.undistort(pixels.astype(np.float64)) for pixels in step)
    shifts, rows = now - before, np.column_stack((now, np.ones(len(now))))
    weights = np.ones((len(now), 1))
    for _ in range(_FLOW_ITERATIONS):
        weighted = rows * weights**2
        information = weighted.T @ rows
        information[_DIAGONAL] *= 1 + _RIDGE
        flow = np.linalg.solve(information, weighted.T @ shifts)
        off = np.linalg.norm(shifts - rows @ flow, axis=1)
        weights = 1 / np.sqrt(1 + (off / (np.median(off) + _MIN_FLOW_PX)) ** 2)[:, None]
    return np.asarray(flow.T / seconds)


class FrontEnd(ABC):
    """Relative motion between frames of one camera.

    :meth:`track_only` tracks through an intermediate frame; :meth:`measure` ends an interval and starts the next.
    """

    # pixels (m, 2) of the same corners in the last measured frame and in the one before, or a later one where corners
    # were renewed between; None for the first frame
    tracks: tuple[FloatArray, FloatArray] | None
    corners: TrackedCorners  # all corners of the last measured frame

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = camera
        self.tracker = CornerTracker()
        self.tracks, self.corners = None, self.tracker.corners()

    def reset(self) -> None:
        """Start a new recording."""
        self.tracker.reset()

    def track_only(self, image: UInt8Array) -> None:
        """Track corners through a frame (height, width[, 3]) without measuring a motion."""
        first = not self.tracker.started
        self.tracker.advance(grey_image(image))
        if first:
            self.tracker.mark()

    def measure(self, image: UInt8Array, beside: ImageCorners | None = None) -> RelativeMotion | None:
        """Motion from the frame measured last to this one; None for the first frame of a recording.

        `beside` are corners of the frame before that are followed with those of the tracker.
        """
        first = not self.tracker.started
        self.tracker.advance(grey_image(image), beside)
        self.tracks = None if first else self.tracker.pairs()
        motion = None if self.tracks is None else self._motion(*self.tracks)
        self.tracker.mark()
        self.corners = self.tracker.corners()
        return motion

    @abstractmethod
    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        """Motion between the marked frame and the current one, from the pixels (n, 2) of the same corners."""


class MotionFrontEnd(FrontEnd):
    """Relative motions with checks for pure rotation, small steps, planes and repeated pictures.

    If corners had to be renewed within an interval, rotations are chained and the direction, which would need the
    lengths of the parts, is left out.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__(camera)
        self._parts: list[RelativeMotion] = []  # from the frame measured last to the mark

    def reset(self) -> None:
        """As of the class above."""
        super().reset()
        self._parts = []

    def track_only(self, image: UInt8Array) -> None:
        """As of the class above; corners are renewed where most of them are lost."""
        super().track_only(image)
        pairs = self.tracker.pairs()
        if len(pairs[0]) < _REMARK_BELOW * self.tracker.n_at_mark:
            self._parts.append(self._since_mark(*pairs))
            self.tracker.mark()

    def measure(self, image: UInt8Array, beside: ImageCorners | None = None) -> RelativeMotion | None:
        """As of the class above, but with status ``TOO_FEW`` if the first frame of a recording is blank."""
        motion = super().measure(image, beside)
        if motion is None and self.tracker.n_at_mark < MIN_TRACKS:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=self.tracker.n_at_mark)
        return motion

    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        parts, self._parts = self._parts, []
        return _chain(parts, self._since_mark(before, now))

    def _since_mark(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        return estimate_relative_motion(before, now, self.camera, self.tracker.n_at_mark)


def _chain(parts: list[RelativeMotion], last: RelativeMotion) -> RelativeMotion:
    """The rotation of all motions one after another; the last one where it is alone."""
    if not parts:
        return last
    rotations = [part.R_prev_next for part in (*parts, last) if part.R_prev_next is not None]
    if len(rotations) <= len(parts):
        broken = any(not part.reliable for part in parts)
        status = MotionStatus.LOST if broken else last.status
        return RelativeMotion(status, n_tracks=last.n_tracks, n_inliers=last.n_inliers)
    variance = sum(part.rotation_sigma_rad**2 for part in (*parts, last))
    rotation, sigma = reduce(np.matmul, rotations), float(np.sqrt(variance))
    return RelativeMotion(MotionStatus.LOW_PARALLAX, rotation, None, last.n_tracks, last.n_inliers, sigma)


class EssentialFrontEnd(FrontEnd):
    """Rotation and direction by OpenCV's essential matrix, as in section 3 of the paper.

    It has none of the checks of :class:`MotionFrontEnd`: it gives a direction whenever it finds a matrix.
    """

    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        n = len(before)
        if n < _ESSENTIAL_CORNERS:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=n)
        view = solve_opencv(self.camera.undistort(before), self.camera.undistort(now), self.camera)
        if view is None:
            return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n)
        n_inliers = int(view.inliers.sum())
        return RelativeMotion(MotionStatus.OK, view.R_prev_next, view.direction_prev, n, n_inliers)
