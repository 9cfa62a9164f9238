"""What Nav2 expects of a localizer: the transform from odometry's frame to the map's, and whether it is kept up.

Odometry says where the robot's base is in a frame that drifts, ``T_odom_base``; a reliable pose says where that frame
lies in the map: ``T_map_odom = T_map_cam T_cam_base T_base_odom``, all at the time of the image.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.pipeline.estimates import Estimate

from .conversion import ERROR, NANOSECONDS, OK, WARN, Conversion, RosError, is_lost
from .parameters import Parameters
from .transforms import covariance_at, map_from_odom

# Called with two frames a and b and a time in nanoseconds: ``T_a_b`` (4, 4), or a RosError that says what is missing
LookUp: TypeAlias = Callable[[str, str, int], FloatArray]


class MapToOdom:
    """Keeps ``T_map_odom`` up by reliable poses. Without them it stands still: the robot moves on by odometry alone."""

    def __init__(self, conversion: Conversion, look_up: LookUp, given: Parameters) -> None:
        self._conversion, self._look_up, self._given = conversion, look_up, given
        self.reset()

    def reset(self) -> None:
        """Forget odometry: time was set back."""
        self._T_map_odom: FloatArray | None = None
        self._image_ns = self._reliable_ns = self._sent_ns = 0  # of the last image, reliable pose, and transform
        self._reliable = False  # whether there was a reliable pose at all
        self._problem, self._missing = "no image yet", ""

    def update(self, estimate: Estimate, stamp_ns: int, camera_frame: str) -> Any:
        """Take the estimate of an image; the pose of the base as a message, None where its camera is not on ``/tf``."""
        self._image_ns, self._problem, self._missing = stamp_ns, estimate.problem, ""
        header = self._conversion.header(stamp_ns)
        if is_lost(estimate) or estimate.pose is None or estimate.covariance is None:
            return self._conversion.uncertain(header)
        try:
            T_base_cam = self._look_up(self._given.base_frame, camera_frame, stamp_ns)
        except RosError as exc:
            self._missing = str(exc)
            return None
        T_map_cam = estimate.pose.pose_se3
        T_map_base = T_map_cam @ np.linalg.inv(T_base_cam)
        if estimate.reliable:
            self._place_odometry(T_map_base, stamp_ns)
        covariance = covariance_at(estimate.covariance, T_map_base[:3, 3] - T_map_cam[:3, 3])
        return self._conversion.uncertain(header, self._conversion.pose_of(T_map_base), covariance)

    def miss(self, problem: str) -> None:
        """No image came: `problem` says so."""
        self._problem, self._missing = problem, ""

    def transform(self, elapsed_ns: int = 0) -> Any:
        """The transform so many nanoseconds after the last image, valid for the tolerance; None before the first.

        Its time lies in the future by the tolerance, and never before that of the last message.
        """
        if self._T_map_odom is None:
            return None
        valid_ns = self._image_ns + elapsed_ns + round(self._given.transform_tolerance * NANOSECONDS)
        self._sent_ns = max(valid_ns, self._sent_ns + 1)
        return self._conversion.transform(self._sent_ns, self._given.odom_frame, self._T_map_odom)

    def status(self, now_ns: int, elapsed_ns: int = 0) -> Any:
        """A message for ``/diagnostics``, so many nanoseconds after the last image."""
        still_s = (self._image_ns + elapsed_ns - self._reliable_ns) / NANOSECONDS if self._reliable else None
        stands = "standing still" if self._given.publish_tf else "no reliable pose"
        if self._missing:
            level, text = ERROR, self._missing
        elif not self._problem:
            level, text = OK, "reliable"
        elif still_s is None:
            level, text = ERROR, f"no reliable pose yet: {self._problem}"
        else:
            level, text = WARN, f"{stands} since {still_s:.1f} s: {self._problem}"
        pairs = {"seconds since a reliable pose": "never" if still_s is None else f"{still_s:.3f}"}
        return self._conversion.diagnostic(self._conversion.header(now_ns), level, "localization", text, pairs)

    def _place_odometry(self, T_map_base: FloatArray, stamp_ns: int) -> None:
        given = self._given
        if given.publish_tf:
            try:
                T_odom_base = self._look_up(given.odom_frame, given.base_frame, stamp_ns)
            except RosError as exc:
                self._missing = str(exc)
                return
            self._T_map_odom = map_from_odom(T_map_base, T_odom_base, planar=given.planar)
        self._reliable_ns, self._reliable = stamp_ns, True
