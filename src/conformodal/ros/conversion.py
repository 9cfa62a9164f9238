"""From estimates to ROS 2 messages: poses with covariances, candidates with weights, regions as boxes, the path.

A lost frame (no image, or one that shows no known place) has no pose: its message holds the identity with a very large
covariance, and neither candidates nor boxes.
"""

from __future__ import annotations

from array import array
from collections import deque
from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.ranges import as_member
from conformodal.core.words import as_utf8
from conformodal.geometry import Trajectory
from conformodal.localizer.candidates import LEAST_VARIANCE, Candidates, weights_of
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.estimates import Estimate

from .conventions import Conventions, Covariance, RosError, is_lost
from .messages import MakeMessage, make_header, make_pose, nanoseconds, rosbags_factory


def pose_covariance(estimate: Estimate, kind: Covariance) -> FloatArray:
    """Covariance (6, 6) of an estimate's pose: :attr:`Estimate.covariance`, or that of the chosen place alone."""
    if as_member(kind, Covariance, "covariance", RosError) is Covariance.MIXTURE:
        assert estimate.covariance is not None
        return estimate.covariance
    assert estimate.position_spread_m is not None
    assert estimate.orientation_spread_rad is not None
    variances = estimate.position_spread_m**2 / 3, estimate.orientation_spread_rad**2
    return np.diag(np.maximum(np.repeat(variances, 3), LEAST_VARIANCE))


_COLOURS = {"region": (86 / 255, 180 / 255, 233 / 255), "places": (0.0, 114 / 255, 178 / 255)}
_FAINTEST, _FULLEST = 0.15, 0.8
_CUBE, _DELETE_ALL = 1, 3
_OK, _WARN, _ERROR = 0, 1, 2


class Boxes(NamedTuple):
    """Boxes (m, 3, 2) of positions in metres, the probability (m,) of each, and the number of all boxes."""

    edges_m: FloatArray
    probabilities: FloatArray
    n_all: int


def region_boxes(estimate: Estimate, region: PoseRegions | None, how: Conventions) -> Boxes:
    """The boxes of a region's positions; a lost frame, whose region is unbounded, has none."""
    if is_lost(estimate) or region is None or estimate.pose is None:
        return Boxes(np.empty((0, 3, 2)), np.empty(0), 0)
    here = estimate.pose.positions_xyz[0][:, None]
    places = region.places(0)
    shown = [place for place in places if place.box is not None][: how.most_boxes]
    edges = [np.clip(place.box[:3], here - how.range_m, here + how.range_m) for place in shown if place.box is not None]
    return Boxes(np.reshape(edges, (-1, 3, 2)), np.array([place.probability for place in shown]), len(places))


class Conversion:
    """Converts estimates to messages one by one, and keeps the path.

    `how` has names and limits; `make` makes a message of a type, by default in the classes of rosbags.
    """

    def __init__(self, how: Conventions | None = None, make: MakeMessage | None = None) -> None:
        self.how, self.make = how or Conventions(), make or rosbags_factory()
        self.reset()

    def reset(self) -> None:
        """Forget the path: another recording begins."""
        self._path: deque[tuple[float, Any]] = deque(maxlen=self.how.longest_path)
        self._lost: deque[float] = deque(maxlen=self.how.longest_path)  # times
        self._n_answered = 0

    def messages(self, estimate: Estimate, stamp_ns: int | None = None) -> dict[str, Any]:
        """All messages about a frame by topic, see :data:`TOPICS`; the path in every :attr:`Conventions.path_every`.

        `stamp_ns` is the frame's time in nanoseconds, by default the estimate's.
        """
        stamp_ns = nanoseconds(estimate.timestamp_s) if stamp_ns is None else stamp_ns
        header = self.header(stamp_ns)
        region = region_boxes(estimate, estimate.region, self.how)
        places = region_boxes(estimate, estimate.path_region, self.how)
        messages = {
            "pose": self._pose(estimate, header),
            **self._candidates(estimate, header),
            "region": self._region({"region": region, "places": places}, header),
            "status": self._status(estimate, header, region),
        }
        if self._extend_path(estimate):
            messages["path"] = self.path(stamp_ns)
        return messages

    def path(self, stamp_ns: int) -> Any:
        """The trajectory so far without lost frames, its last poses revised by what followed."""
        poses = [self.stamped(nanoseconds(time_s), pose) for time_s, pose in self._path]
        return self.make("nav_msgs/msg/Path", header=self.header(stamp_ns), poses=poses)

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        """A header, by default in the world's frame."""
        return make_header(self.make, stamp_ns, self.how.world_frame if frame is None else frame)

    def stamped(self, stamp_ns: int, pose: Any) -> Any:
        """A pose with a time."""
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns), pose=pose)

    def poses(self, of: Trajectory | Candidates) -> list[Any]:
        """Messages of poses."""
        pairs = zip(of.positions_xyz, of.orientations_quat_wxyz, strict=True)
        return [make_pose(self.make, position, quat) for position, quat in pairs]

    def _pose(self, estimate: Estimate, header: Any) -> Any:
        pose, covariance = make_pose(self.make), np.eye(6) * self.how.lost_variance
        if not is_lost(estimate) and estimate.pose is not None:
            pose, covariance = self.poses(estimate.pose)[0], pose_covariance(estimate, self.how.covariance)
        inner = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel())
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=inner)

    def _candidates(self, estimate: Estimate, header: Any) -> dict[str, Any]:
        """Candidate poses, most probable first, and their weights in the same order."""
        poses, weights = list[Any](), array("d")
        if not is_lost(estimate) and estimate.candidates is not None:
            poses, weights = self.poses(estimate.candidates), array("d", weights_of(estimate.candidates).tolist())
        axis = self.make("std_msgs/msg/MultiArrayDimension", label="candidate", size=len(poses), stride=len(poses))
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[axis])
        return {
            "candidates": self.make("geometry_msgs/msg/PoseArray", header=header, poses=poses),
            "candidate_weights": self.make("std_msgs/msg/Float64MultiArray", layout=layout, data=weights),
        }

    def _region(self, by_name: dict[str, Boxes], header: Any) -> Any:
        """Boxes to draw, more opaque with higher probability; first an order to remove the previous frame's."""
        kind = "visualization_msgs/msg/Marker"
        markers = [self.make(kind, header=header, type=_CUBE, action=_DELETE_ALL, pose=make_pose(self.make))]
        for name, boxes in by_name.items():
            for number, (box, probability) in enumerate(zip(boxes.edges_m, boxes.probabilities, strict=True)):
                opacity = _FAINTEST + (_FULLEST - _FAINTEST) * float(probability)
                colour = dict(zip("rgba", (*_COLOURS[name], opacity), strict=True))
                size = dict(zip("xyz", np.ptp(box, axis=1).tolist(), strict=True))
                marker = {
                    "pose": make_pose(self.make, box.mean(axis=1)),
                    "scale": self.make("geometry_msgs/msg/Vector3", **size),
                    "color": self.make("std_msgs/msg/ColorRGBA", **colour),
                }
                markers.append(self.make(kind, header=header, ns=name, id=number, type=_CUBE, **marker))
        return self.make("visualization_msgs/msg/MarkerArray", markers=markers)

    def _status(self, estimate: Estimate, header: Any, region: Boxes) -> Any:
        """An error for a lost frame, a warning where motion could not be used."""
        motion = estimate.relative_motion
        pairs = {
            "evidence": "none" if estimate.evidence is None else estimate.evidence.name.lower(),
            "known_p": "" if estimate.known_p is None else f"{estimate.known_p:.6g}",
            "motion": "none" if motion is None else str(motion.status),
            "boxes": str(region.n_all),
            "boxes_shown": str(len(region.edges_m)),
        }
        status = self.make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=_ERROR if is_lost(estimate) else _OK if estimate.reliable else _WARN,
            name="conformodal: pose",
            message=as_utf8(estimate.problem or "reliable"),
            values=[self.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in pairs.items()],
        )
        return self.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def _extend_path(self, estimate: Estimate) -> bool:
        """Add the pose to the path; where the path is to be published, also revise its last poses."""
        if estimate.pose is None:
            return False
        if is_lost(estimate):
            self._lost.append(estimate.timestamp_s)
        due = self._n_answered % self.how.path_every == 0
        revised = (estimate.revised if due else None) or estimate.pose  # hindsight takes time
        first = float(revised.timestamps_s[0])
        while self._path and self._path[-1][0] >= first:
            self._path.pop()
        for time_s, pose in zip(revised.timestamps_s.tolist(), self.poses(revised), strict=True):
            if time_s not in self._lost:
                self._path.append((time_s, pose))
        self._n_answered += 1
        return due
