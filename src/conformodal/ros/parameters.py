"""The node's parameters."""

from __future__ import annotations

from dataclasses import dataclass

from .conversion import RosError


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node, by their names in ROS; RosError if one cannot be used."""

    model: str = ""  # folder of a saved model
    world_frame: str = "map"  # of poses: the world of the training poses
    compressed: bool = False  # whether images are ``sensor_msgs/CompressedImage``
    # after so many seconds without an image the pose counts as lost; also the time between two such messages
    silent_s: float = 1.0
    publish_tf: bool = True  # whether to publish where `odom_frame` lies in `world_frame`
    odom_frame: str = "odom"  # in which odometry says where `base_frame` is
    base_frame: str = "base_link"  # of the robot; the camera's frame is named by its images
    planar: bool = False  # whether `odom_frame` is placed by x, y and heading alone
    transform_tolerance: float = 1.0  # seconds after an image that the transform stays valid

    def __post_init__(self) -> None:
        for name in ("silent_s", "transform_tolerance"):
            if not getattr(self, name) > 0:
                raise RosError(f"parameter {name} must be more than 0 s, got {getattr(self, name)}")
        frames = self.world_frame, self.odom_frame, self.base_frame
        if not all(frames) or len(set(frames)) < len(frames):
            raise RosError(f"parameters world_frame, odom_frame and base_frame must name three frames, got {frames}")
