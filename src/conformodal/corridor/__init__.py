"""Worlds whose rooms look alike, and the truth about what looks alike in them."""

from conformodal.core.extras import require_extra

with require_extra("train", "the corridor world"):
    import trimesh  # noqa: F401

from .path import drone_path
from .render import CAMERA, Renderer, same_views
from .world import CorridorWorld
from .writer import write_corridor, write_flight

__all__ = [
    "CAMERA",
    "CorridorWorld",
    "Renderer",
    "drone_path",
    "same_views",
    "write_corridor",
    "write_flight",
]
