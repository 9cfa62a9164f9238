"""ROS 2: estimates as messages, recordings of them, a live node. What needs rosbags or rclpy imports it when used."""

from .bag import BagWriter
from .conventions import TOPICS, Conventions, Covariance, is_lost
from .conversion import Conversion
from .covariance import mixture_covariance
from .errors import RosError

__all__ = [
    "TOPICS",
    "BagWriter",
    "Conventions",
    "Conversion",
    "Covariance",
    "RosError",
    "is_lost",
    "mixture_covariance",
]
