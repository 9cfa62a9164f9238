"""Worlds whose rooms look alike, and the truth about what looks alike in them."""

from conformodal.core.extras import require_extra

with require_extra("train", "the corridor world"):
    import trimesh  # noqa: F401

from .ambiguity import same_views
from .flight import drone_pass, drone_path, write_corridor, write_flight, write_passes
from .render import CAMERA, Renderer
from .world import CorridorWorld

__all__ = [
    "CAMERA",
    "CorridorWorld",
    "Renderer",
    "drone_pass",
    "drone_path",
    "same_views",
    "write_corridor",
    "write_flight",
    "write_passes",
]
