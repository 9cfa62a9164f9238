"""Landmarks: corners of frames with known poses, placed in the world, and poses of other frames from them."""

from .described import Described, describe, match
from .keyframes import LandmarkMap
from .mapping import build_map

__all__ = ["Described", "LandmarkMap", "build_map", "describe", "match"]
