"""Worlds whose rooms look alike, and the truth about what looks alike in them."""

from conformodal.core import needing

with needing("train", "the corridor world"):
    import trimesh  # noqa: F401

from .building import half_turn
from .path import drone_path, visiting_path
from .render import CAMERA, Renderer
from .repeated_views import same_views
from .turned_rooms import TurnedRooms
from .world import CorridorWorld
from .writer import write_corridor, write_flight

__all__ = [
    "CAMERA",
    "CorridorWorld",
    "Renderer",
    "TurnedRooms",
    "drone_path",
    "half_turn",
    "same_views",
    "visiting_path",
    "write_corridor",
    "write_flight",
]
