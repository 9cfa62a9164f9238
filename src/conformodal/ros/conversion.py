"""From estimates to ROS 2 messages: poses with covariances, candidates with weights, regions as boxes, the path.

A lost frame (no image, or one that shows no known place) has no pose: its message holds the identity with a very large
covariance, and neither candidates nor boxes.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.words import as_utf8
from conformodal.geometry import Trajectory
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.pipeline.estimates import Estimate

# Called with the name of a type and some of its fields. Sequences of numbers are given as an array.array, those of
# fixed length as a NumPy array.
MakeMessage = Callable[..., Any]

# topic: type of its messages
TOPICS = {
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "candidates": "geometry_msgs/msg/PoseArray",
    "candidate_weights": "std_msgs/msg/Float64MultiArray",
    "region": "visualization_msgs/msg/MarkerArray",
    "path": "nav_msgs/msg/Path",
    "status": "diagnostic_msgs/msg/DiagnosticArray",
}
# of recordings only
TRUTH = {"truth": "geometry_msgs/msg/PoseStamped"}
IMAGE = {"image/compressed": "sensor_msgs/msg/CompressedImage"}
# of the node only
LIVE = {"base_pose": TOPICS["pose"]}

NANOSECONDS = 1_000_000_000
_LAST_SECOND = 2**31 - 1
_LOST_VARIANCE = 1e6  # of every coordinate of a lost frame, m^2 and rad^2
_COLOURS = {"region": (86 / 255, 180 / 255, 233 / 255), "places": (0.0, 114 / 255, 178 / 255)}
_FAINTEST, _FULLEST = 0.15, 0.8
NAMESPACE = "/conformodal"  # of all topics
CAMERA_FRAME = "camera_optical_frame"  # of images: x right, y down, z forward
_CUBE, _DELETE_ALL = 1, 3
OK, WARN, ERROR = 0, 1, 2  # levels of diagnostics


class RosError(ConformodalError):
    """Something that ROS messages cannot hold, or a parameter that the node cannot use."""


def rosbags_factory() -> MakeMessage:
    """Makes messages in the classes of rosbags; fields that are not given are zero or empty."""
    with require_extra("ros", "ROS messages"):
        from rosbags.interfaces import Nodetype  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    store: Any = get_typestore(Stores.ROS2_HUMBLE)

    def default(node: Any, what: Any) -> Any:
        if node == Nodetype.NAME:
            return make(what)
        if node == Nodetype.BASE:
            return {"string": "", "bool": False}.get(what[0], 0)
        (of, name), _ = what
        return [] if of == Nodetype.NAME else np.empty(0, dtype=name[0])

    def make(kind: str, **given: Any) -> Any:
        missing = {name: default(*of) for name, of in store.fielddefs[kind][1] if name not in given}
        arrays = {name: np.asarray(value) for name, value in given.items() if isinstance(value, array)}
        return store.types[kind](**{**missing, **given, **arrays})

    return make


def nanoseconds(timestamp_s: float) -> int:
    """A time in whole nanoseconds; whole seconds are converted apart, so that no digit is lost."""
    sec = math.floor(timestamp_s)
    return sec * NANOSECONDS + round((timestamp_s - sec) * NANOSECONDS)


def is_lost(estimate: Estimate) -> bool:
    """Whether the pose must not be used: there is no image, or it shows no known place."""
    return estimate.pose is None or estimate.evidence is EvidenceType.UNKNOWN


@dataclass(frozen=True)
class MessageLimits:
    """How much messages hold."""

    max_boxes: int = 256  # per region, the most probable first
    range_m: float = 100.0  # where boxes are cut off, from the chosen position along each axis
    max_path_poses: int = 1000
    path_every: int = 10  # answered frames per published path


class Conversion:
    """Converts estimates to messages one by one, and keeps the path.

    `world_frame` is that of poses, the world of the training poses; `make` makes a message of a type, by default in the
    classes of rosbags.
    """

    def __init__(
        self, world_frame: str = "map", make: MakeMessage | None = None, limits: MessageLimits | None = None
    ) -> None:
        self._world_frame, self.make = world_frame, make or rosbags_factory()
        self._limits = limits or MessageLimits()
        self.reset()

    def reset(self, begin_s: float = -math.inf) -> None:
        """Forget the path: another recording begins, or an operator places the camera.

        Poses before `begin_s` stay out of the path: what an operator says is not an estimate.
        """
        self._begin_s = begin_s
        most = self._limits.max_path_poses
        self._path: deque[tuple[float, Any]] = deque(maxlen=most)
        self._lost: deque[float] = deque(maxlen=most)  # times
        self._n_answered = 0

    def messages(self, estimate: Estimate, stamp_ns: int) -> dict[str, Any]:
        """All messages about a frame by topic, see :data:`TOPICS`; the path in every tenth.

        `stamp_ns` is the frame's time in nanoseconds.
        """
        header = self.header(stamp_ns)
        messages = {
            "pose": self._pose(estimate, header),
            **self._candidates(estimate, header),
            "region": self._region(estimate, header),
            "status": self._status(estimate, header),
        }
        if self._extend_path(estimate):
            messages["path"] = self.path(stamp_ns)
        return messages

    def path(self, stamp_ns: int) -> Any:
        """The trajectory so far without lost frames, its last poses revised by what followed."""
        poses = [self.stamped(nanoseconds(time_s), pose) for time_s, pose in self._path]
        return self.make("nav_msgs/msg/Path", header=self.header(stamp_ns), poses=poses)

    def header(self, stamp_ns: int, frame: str | None = None) -> Any:
        """A header, by default in the world's frame; ROS holds times from 0 to 2^31 - 1 s."""
        sec, nanosec = divmod(stamp_ns, NANOSECONDS)
        if not 0 <= sec <= _LAST_SECOND:
            raise RosError(f"a time of ROS must lie within 0 and {_LAST_SECOND} s, got {stamp_ns / NANOSECONDS:.9g} s")
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame or self._world_frame)

    def stamped(self, stamp_ns: int, pose: Any) -> Any:
        """A pose with a time."""
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns), pose=pose)

    def pose(self, position_xyz: npt.ArrayLike = (0, 0, 0), quat_wxyz: npt.ArrayLike = (1, 0, 0, 0)) -> Any:
        """A pose, by default the identity; ROS has the real part of a quaternion last."""
        (x, y, z), (qw, qx, qy, qz) = (np.asarray(v, dtype=np.float64).tolist() for v in (position_xyz, quat_wxyz))
        position = self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        orientation = self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def uncertain(self, header: Any, pose: Any = None, covariance: FloatArray | None = None) -> Any:
        """A pose with its covariance (6, 6); without them that of a lost frame."""
        spread = np.eye(6) * _LOST_VARIANCE if covariance is None else covariance
        pose = self.pose() if pose is None else pose
        inner = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=spread.ravel())
        return self.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=inner)

    def transform(self, stamp_ns: int, child: str, T_world_child: FloatArray) -> Any:
        """The transform (4, 4) from a frame to the world's, for ``/tf``."""
        pose = self.pose_of(T_world_child)
        at = pose.position
        shift = self.make("geometry_msgs/msg/Vector3", x=at.x, y=at.y, z=at.z)
        moved = self.make("geometry_msgs/msg/Transform", translation=shift, rotation=pose.orientation)
        kind, header = "geometry_msgs/msg/TransformStamped", self.header(stamp_ns)
        return self.make(kind, header=header, child_frame_id=child, transform=moved)

    def diagnostic(self, header: Any, level: int, name: str, message: str, pairs: Mapping[str, str]) -> Any:
        """One status of a name: a level, a message, and pairs of keys and values."""
        values = [self.make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in pairs.items()]
        given = {"level": level, "name": f"conformodal: {name}", "message": as_utf8(message), "values": values}
        status = self.make("diagnostic_msgs/msg/DiagnosticStatus", **given)
        return self.make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def pose_of(self, T: FloatArray) -> Any:
        """The pose of a transform (4, 4)."""
        return self.poses(Trajectory.from_poses_se3([0.0], T[None]))[0]

    def poses(self, of: Trajectory | PoseMixture) -> list[Any]:
        """Messages of poses."""
        return [self.pose(*pair) for pair in zip(of.positions_xyz, of.orientations_quat_wxyz, strict=True)]

    def _pose(self, estimate: Estimate, header: Any) -> Any:
        if is_lost(estimate) or estimate.pose is None or estimate.covariance is None:
            return self.uncertain(header)
        pose = self.pose(estimate.pose.position_xyz, estimate.pose.orientation_quat_wxyz)
        return self.uncertain(header, pose, estimate.covariance)

    def _candidates(self, estimate: Estimate, header: Any) -> dict[str, Any]:
        """Candidate poses, most probable first, and their weights in the same order."""
        poses, weights = list[Any](), array("d")
        if not is_lost(estimate) and estimate.candidates is not None:
            poses, weights = self.poses(estimate.candidates), array("d", estimate.candidates.weights.tolist())
        axis = self.make("std_msgs/msg/MultiArrayDimension", label="candidate", size=len(poses), stride=len(poses))
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[axis])
        return {
            "candidates": self.make("geometry_msgs/msg/PoseArray", header=header, poses=poses),
            "candidate_weights": self.make("std_msgs/msg/Float64MultiArray", layout=layout, data=weights),
        }

    def _region(self, estimate: Estimate, header: Any) -> Any:
        """Boxes to draw, more opaque with higher probability; first an order to remove the previous frame's."""
        kind = "visualization_msgs/msg/Marker"
        markers = [self.make(kind, header=header, type=_CUBE, action=_DELETE_ALL, pose=self.pose())]
        for name, region in (("region", estimate.region), ("places", estimate.path_region)):
            for number, (box, probability) in enumerate(self._boxes(estimate, region)):
                opacity = _FAINTEST + (_FULLEST - _FAINTEST) * probability
                colour = dict(zip("rgba", (*_COLOURS[name], opacity), strict=True))
                size = dict(zip("xyz", np.ptp(box, axis=1).tolist(), strict=True))
                marker = {
                    "pose": self.pose(box.mean(axis=1)),
                    "scale": self.make("geometry_msgs/msg/Vector3", **size),
                    "color": self.make("std_msgs/msg/ColorRGBA", **colour),
                }
                markers.append(self.make(kind, header=header, ns=name, id=number, type=_CUBE, **marker))
        return self.make("visualization_msgs/msg/MarkerArray", markers=markers)

    def _boxes(self, estimate: Estimate, region: PoseRegions | None) -> list[tuple[FloatArray, float]]:
        """Boxes (3, 2) of a region's positions in metres, each with its probability; none of a lost frame."""
        if is_lost(estimate) or region is None or estimate.pose is None:
            return []
        here = estimate.pose.position_xyz[:, None]
        places = [(place.box, place.probability) for place in region.places(0)[: self._limits.max_boxes]]
        near = here - self._limits.range_m, here + self._limits.range_m
        boxes = [(box[:3], float(probability)) for box, probability in places if box is not None]
        overlap = [((box[:, :1] < near[1]) & (box[:, 1:] > near[0])).all() for box, _ in boxes]
        return [(np.clip(box, *near), p) for (box, p), drawn in zip(boxes, overlap, strict=True) if drawn]

    def _status(self, estimate: Estimate, header: Any) -> Any:
        """An error for a lost frame, a warning where motion could not be used."""
        lost, motion = is_lost(estimate), estimate.relative_motion
        n_boxes = 0 if lost or estimate.region is None else int(estimate.region.n_places[0])
        pairs = {
            "evidence": "none" if estimate.evidence is None else estimate.evidence.name.lower(),
            "known_p": "" if estimate.known_p is None else f"{estimate.known_p:.6g}",
            "motion": "none" if motion is None else str(motion.status),
            "boxes": str(n_boxes),
            "boxes_shown": str(min(n_boxes, self._limits.max_boxes)),
        }
        level = ERROR if lost else OK if estimate.reliable else WARN
        return self.diagnostic(header, level, "pose", estimate.problem or "reliable", pairs)

    def _extend_path(self, estimate: Estimate) -> bool:
        """Add the pose to the path; where the path is to be published, also revise its last poses."""
        if estimate.pose is None:
            return False
        if is_lost(estimate):
            self._lost.append(estimate.timestamp_s)
        due = self._n_answered % self._limits.path_every == 0
        revised = (estimate.revised if due else None) or estimate.pose.at(estimate.timestamp_s)  # hindsight takes time
        first = float(revised.timestamps_s[0])
        while self._path and self._path[-1][0] >= first:
            self._path.pop()
        for time_s, pose in zip(revised.timestamps_s.tolist(), self.poses(revised), strict=True):
            if time_s >= self._begin_s and time_s not in self._lost:
                self._path.append((time_s, pose))
        self._n_answered += 1
        return due
