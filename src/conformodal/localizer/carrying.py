"""Local features of a recording frame by frame: of most frames, corners that were followed from the frame before.

To detect, describe and match local features takes most of a frame's time. Between frames, a corner whose landmark is
known is as well followed by optical flow, and the camera's pose refined from there. Every few frames, local features
are detected again, a part of the work in each of the next frames, and then matched, so that no frame bears all of it.

:class:`FeatureStream` does the same in a run and in calibration, whose thresholds are therefore those of such frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, IntArray, UInt8Array, evenly_spread
from conformodal.features.local import Detector, LocalFeatures, QualityRange, image_quality
from conformodal.geometry import PinholeCamera, RelativeMotion
from conformodal.tracking.tracker import FollowedCorners, ImageCorners, follow_corners

from .evidence import LandmarkView, PoseMeasurement
from .localizer import Localizer, recognised_only
from .sources.registry import CarriesLandmarks
from .turning import TurnTracker


@dataclass(frozen=True)
class CarrySettings:
    """When corners are followed instead of detected."""

    # between detections. This and the shares below were chosen on seed 20 of redkitchen `blocks`, fr1_xyz and fr1_rpy
    detect_every_s: float = 0.16
    max_step_s: float = 0.2  # between frames: corners move too far in more
    max_delay_s: float = 0.12  # from a detected frame to the one in which its features are matched, if both are apart
    max_corners: int = 300  # that are followed
    min_corners: int = 30  # that agree with the pose
    # of the corners that were followed from the last detection, that still agree: below the first, local features are
    # detected again from this frame on, below the second at once, all of it
    renew_share: float = 0.75
    min_share: float = 0.4


class StreamFrame(NamedTuple):
    """The next frame of a recording."""

    grey: UInt8Array  # (height, width)
    timestamp_s: float
    motion: RelativeMotion | None  # from the frame before; None where nothing is known of it
    flow: FloatArray  # (2, 3) pixels per second, see conformodal.tracking.tracker.affine_flow
    followed: FollowedCorners | None = None  # the corners to follow in this frame, if they were followed before


class FrameLook(NamedTuple):
    """What local features tell of a frame."""

    features: LocalFeatures  # detected; or the corners that were followed, without descriptors
    # of the source that follows corners; None where it has yet to be asked for them
    estimates: list[PoseMeasurement] | None = None
    carried: bool = False  # whether corners were followed
    # whether features were detected or matched beside: then other sources, which take as long, are asked only where no
    # place was recognised
    busy: bool = False


class _Anchor(NamedTuple):
    """The corners of a frame that show known landmarks: what the next frame is looked at with."""

    grey: UInt8Array
    timestamp_s: float
    pixels: Float32Array  # (n, 2) as in the image
    view: LandmarkView  # its corners are rows of `pixels`
    detected: PoseMeasurement  # the last estimate from detected features
    n_followed: int  # corners that were followed from that frame on


@dataclass
class _Detection:
    """A frame whose local features are being detected, to be matched with landmarks in a later frame."""

    frame: StreamFrame
    parts: Iterator[LocalFeatures | None]
    n_done: int = 0  # parts; features that were detected before come with the first, and wait as in a run
    features: LocalFeatures | None = None

    def advance(self) -> None:
        """Do the next part."""
        self.features = next(self.parts, self.features)
        self.n_done += 1

    def finish(self) -> LocalFeatures:
        """Do all that is left."""
        *_, features = self.features, *self.parts
        assert features is not None
        return features


class FeatureStream:
    """Decides, frame by frame, whether corners are detected or followed, and how far the image is turned before.

    Unless it `follows` the stream, each frame is looked at by itself, upright; unless it `carries`, corners are
    detected in each frame. Nothing is carried into images whose quality is out of range: those are calibrated alone.
    """

    def __init__(
        self,
        localizer: Localizer,
        camera: PinholeCamera,
        detector: Detector,
        *,
        follows: bool = True,
        carries: bool = True,
        quality: QualityRange | None = None,
        settings: CarrySettings | None = None,
    ) -> None:
        self._camera, self._quality, self._settings = camera, quality, settings or CarrySettings()
        self._n_parts = detector.n_parts
        self._turns = TurnTracker(localizer) if follows and not detector.rotation_invariant else None
        self._source = localizer.carrying_source if follows and carries else None
        self.reset()

    def reset(self) -> None:
        """Start a new recording."""
        if self._turns is not None:
            self._turns.reset()
        self._anchor: _Anchor | None = None
        self._detection: _Detection | None = None  # if its features were not matched yet
        # of the frame before, and when features were detected last
        self._timestamp_s = self._detected_s = -math.inf

    def corners_to_follow(self, timestamp_s: float) -> ImageCorners | None:
        """The corners that :meth:`look` will follow into the next frame, if they are of the one before."""
        anchor = self._anchor
        if anchor is None or self._matches_at(timestamp_s) or not self._is_near(anchor, timestamp_s):
            return None
        return ImageCorners(anchor.grey, anchor.pixels)

    def look(self, frame: StreamFrame, detect: Callable[[float], Iterator[LocalFeatures | None]]) -> FrameLook:
        """Look at the next frame; `detect` gives its local features, the image turned by an angle in radians.

        It does so in parts: None after each, at last the features. :meth:`observe` takes the estimates of the frame
        before the next one is looked at.
        """
        if self._turns is not None:
            self._turns.advance(frame.motion)
        if self._source is None:
            return FrameLook(_Detection(frame, detect(self._turn_rad)).finish())
        anchors, matches = [self._anchor], self._matches_at(frame.timestamp_s)
        if self._detection is not None and matches:
            features = self._detection.finish()
            fresh = self._anchor_at(self._detection.frame, features, self._source.localize(features))
            # corners of the frame before are followed where those of the detected one, some frames ago, are lost
            anchors = [] if fresh is None else [fresh, self._anchor]
            self._detection = None
        self._timestamp_s, self._anchor = frame.timestamp_s, None
        for anchor in anchors:
            followed = None if anchor is None else self._followed(frame, anchor, self._source)
            if followed is not None:
                break
        else:
            features = self._detect(frame, detect).finish()
            estimates = self._source.localize(features)
            self._anchor = self._anchor_at(frame, features, estimates)
            return FrameLook(features, [replace(one, view=None) for one in estimates])
        if self._detection is None and not matches and self._is_due(frame):
            self._detection = self._detect(frame, detect)
        if self._detection is not None:
            self._detection.advance()
        return followed._replace(busy=matches or self._detection is not None)

    def skip(self, motion: RelativeMotion | None) -> None:
        """Pass over the next frame, which moved like this from the one before, without a look."""
        if self._turns is not None:
            self._turns.advance(motion)
        self._anchor = self._detection = None

    def _is_due(self, frame: StreamFrame) -> bool:
        """Whether local features are to be detected in a frame that was followed."""
        if frame.timestamp_s - self._detected_s >= self._settings.detect_every_s or self._anchor is None:
            return True
        return len(self._anchor.pixels) < self._settings.renew_share * self._anchor.n_followed

    def _matches_at(self, timestamp_s: float) -> bool:
        """Whether a detected frame's features are to be matched in the one of this time: once all parts are done.

        Earlier, if the next frame would be too late.
        """
        if self._detection is None:
            return False
        step_s = timestamp_s - self._timestamp_s
        late = timestamp_s + step_s - self._detection.frame.timestamp_s > self._settings.max_delay_s
        return late or self._detection.n_done >= self._n_parts

    def _detect(self, frame: StreamFrame, detect: Callable[[float], Iterator[LocalFeatures | None]]) -> _Detection:
        self._detected_s, self._detection = frame.timestamp_s, None
        return _Detection(frame, detect(self._turn_rad))

    @property
    def _turn_rad(self) -> float:
        """The angle by which the current image is turned before features are detected."""
        return 0.0 if self._turns is None else self._turns.turn_rad

    def observe(self, estimates: Sequence[PoseMeasurement]) -> None:
        """Take the estimates of the current frame."""
        if self._turns is not None:
            self._turns.observe(estimates)

    def _anchor_at(
        self, frame: StreamFrame, features: LocalFeatures, estimates: Sequence[PoseMeasurement]
    ) -> _Anchor | None:
        """Corners to follow from a frame; None where not exactly one place was recognised, or by too few of them."""
        recognised = recognised_only(estimates)
        if len(recognised) != 1 or (view := recognised[0].view) is None:
            return None
        corners = np.unique(view.corners)
        if len(corners) < self._settings.min_corners:
            return None
        # detectors give corners in order of their strength: take strong and weak ones, which are from all of the image
        corners = corners[evenly_spread(len(corners), self._settings.max_corners)]
        pixels = self._camera.distort(features.pixels[corners]).astype(np.float32)
        return _Anchor(frame.grey, frame.timestamp_s, pixels, _rows_of(view, corners), recognised[0], len(corners))

    def _is_near(self, anchor: _Anchor, timestamp_s: float) -> bool:
        """Whether corners can be followed into a frame of this time."""
        return 0 < timestamp_s - anchor.timestamp_s <= self._settings.max_step_s

    def _followed(self, frame: StreamFrame, anchor: _Anchor, source: CarriesLandmarks) -> FrameLook | None:
        """The look at a frame with the corners of one before; None where too few can be followed."""
        if not self._is_near(anchor, frame.timestamp_s):
            return None
        quality = image_quality(frame.grey)
        if self._quality is not None and self._quality.is_outside(quality[None])[0]:
            return None
        there, alive = frame.followed or follow_corners(anchor.grey, frame.grey, anchor.pixels)
        if alive.sum() < self._settings.min_corners:
            return None
        pixels = there[alive]
        nothing = np.empty((0, 0), np.uint8), np.empty(0, np.float32)
        features = LocalFeatures(self._camera.undistort(pixels.astype(np.float64)), *nothing, quality, frame.flow)
        view = _rows_of(anchor.view, np.flatnonzero(alive))
        estimate = source.carry(features, view, anchor.detected, anchor.n_followed)
        if estimate is None or estimate.view is None or not recognised_only([estimate]):
            return None
        inliers = np.unique(estimate.view.corners)
        if len(inliers) < max(self._settings.min_corners, self._settings.min_share * anchor.n_followed):
            return None
        view = _rows_of(estimate.view, inliers)
        self._anchor = anchor._replace(
            grey=frame.grey, timestamp_s=frame.timestamp_s, pixels=pixels[inliers], view=view
        )
        return FrameLook(features, [replace(estimate, view=None)], carried=True)


def _rows_of(view: LandmarkView, corners: IntArray) -> LandmarkView:
    """A view of some of its corners, increasing; these are numbered anew."""
    at = np.searchsorted(corners, view.corners)
    there = corners[np.minimum(at, len(corners) - 1)] == view.corners
    return LandmarkView(at[there], view.landmarks[there], view.T_world_cam)
