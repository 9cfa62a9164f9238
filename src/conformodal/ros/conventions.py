"""Names of frames and topics, limits, and when a pose counts as lost."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import as_member
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.estimates import Estimate


class RosError(ConformodalError):
    """Something that ROS messages cannot hold, or a recording that cannot be written."""


class Covariance(StrEnum):
    """What the covariance of the chosen pose is computed from."""

    MIXTURE = "mixture"  # all hypotheses of the posterior: ambiguity makes it large
    CHOSEN = "chosen"  # the spread of the chosen place alone


@dataclass(frozen=True)
class Conventions:
    """Names of frames and topics, and limits."""

    world_frame: str = "map"  # of poses: the world of the training poses
    camera_frame: str = "camera_optical_frame"  # of images: x right, y down, z forward
    namespace: str = "/conformodal"  # of all topics
    covariance: Covariance = Covariance.MIXTURE
    lost_variance: float = 1e6  # of every coordinate of a lost frame, m^2 and rad^2
    most_boxes: int = 256  # per region: those with the highest probability, then the nearest
    range_m: float = 100.0  # where boxes are cut off, from the chosen position along each axis
    longest_path: int = 1000  # poses
    path_every: int = 10  # answered frames per published path

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", as_member(self.covariance, Covariance, "covariance", RosError))

    def topic(self, name: str) -> str:
        """A topic with its namespace."""
        return f"{self.namespace}/{name}"


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


def is_lost(estimate: Estimate) -> bool:
    """Whether the pose must not be used: there is no image, or it shows no known place."""
    return estimate.pose is None or estimate.evidence is EvidenceType.UNKNOWN
