"""The corridor world: a dark hallway of identical doors and rooms, and the truth about what looks alike in it."""

from .ambiguity import same_views
from .path import drone_path
from .render import CAMERA, Renderer
from .world import CorridorWorld
from .writer import write_corridor, write_flight

__all__ = ["CAMERA", "CorridorWorld", "Renderer", "drone_path", "same_views", "write_corridor", "write_flight"]
