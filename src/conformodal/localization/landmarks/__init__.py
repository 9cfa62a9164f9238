"""PnP on landmarks: corners of keyframes, triangulated, and poses of other images from the ones they match."""

from .keyframes import LandmarkMap
from .mapping import build_map
from .source import LandmarkSource

__all__ = ["LandmarkMap", "LandmarkSource", "build_map"]
