"""Names of frames and topics, limits, and what lost means."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from conformodal.core.choices import as_member
from conformodal.model.region_rules import EvidenceType
from conformodal.running.estimates import Estimate

from . import messages as ros
from .errors import RosError


class Covariance(StrEnum):
    """What the covariance of the chosen pose is made of."""

    MIXTURE = "mixture"  # the whole belief: other places that the image may show make it large
    CHOSEN = "chosen"  # the spread of the chosen candidate alone, as if no other could be right


@dataclass(frozen=True)
class Conventions:
    """Names of frames and topics, and limits.

    Attributes
    ----------
    world_frame
        The frame that poses are in: the world of the training poses.
    camera_frame
        Of images: x right, y down, z forward.
    namespace
        Of all topics.
    covariance
        Of the pose.
    lost_variance
        Of every coordinate, in m^2 and rad^2, where the frame is lost.
    most_boxes
        Of a region. Those that hold most of the belief come first, then the nearest.
    range_m
        Boxes end this far from the chosen position along each axis.
    longest_path
        Poses of the path.
    path_every
        The path is said anew after so many answered frames.

    Raises
    ------
    RosError
        If `covariance` is not one of :class:`Covariance`.
    """

    world_frame: str = "map"
    camera_frame: str = "camera_optical_frame"
    namespace: str = "/conformodal"
    covariance: Covariance = Covariance.MIXTURE
    lost_variance: float = 1e6
    most_boxes: int = 256
    range_m: float = 100.0
    longest_path: int = 1000
    path_every: int = 10

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", as_member(self.covariance, Covariance, "covariance", RosError))

    def topic(self, name: str) -> str:
        """The whole name of a topic."""
        return f"{self.namespace}/{name}"


# name: type
TOPICS: dict[str, type[ros.RosMessage]] = {
    "pose": ros.PoseWithCovarianceStamped,
    "candidates": ros.PoseArray,
    "candidate_weights": ros.Float64MultiArray,
    "region": ros.MarkerArray,
    "path": ros.Path,
    "status": ros.DiagnosticArray,
}
# of recordings only
TRUTH: dict[str, type[ros.RosMessage]] = {"truth": ros.PoseStamped}
IMAGE: dict[str, type[ros.RosMessage]] = {"image/compressed": ros.CompressedImage}


def is_lost(estimate: Estimate) -> bool:
    """Whether nothing may be built on the pose: there is no image, or it shows no place that is known."""
    return estimate.pose is None or estimate.evidence is EvidenceType.UNKNOWN
