"""Landmarks: corners of frames with known poses, placed in the world, and poses of other frames from them."""

from .described import Described, Matcher, describe, match
from .keyframes import LandmarkMap
from .mapping import build_map

__all__ = ["Described", "LandmarkMap", "Matcher", "build_map", "describe", "match"]
