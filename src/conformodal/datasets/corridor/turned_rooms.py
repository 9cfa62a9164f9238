"""Two rooms that are one another's half-turn, with a lobby between: nothing in a room says on which side it lies.

The building is the same after a turn by 180 degrees about the vertical axis through its middle, but for a poster in the
lobby. Passages between lobby and rooms are so deep, and the lobby is so short and wide, that the poster's wall is not
seen from the rooms: no line through both ends of a passage meets it. Frame: the middle of the lobby's floor is the
origin, the rooms lie towards +x and -x, the poster hangs on the wall towards +y; metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import trimesh

from .building import Building, Panel, half_turn, mesh_of
from .world import DOOR_CENTRE, DOOR_HEIGHT, HEIGHT, ROOM_NEAR, room

LOBBY_X, LOBBY_Y = 0.9, 2.6  # half its length and width
ROOM_X = 2.1  # where the passage ends and the room begins
DOOR_Y = 0.6  # half the width of the passage


@dataclass
class TurnedRooms(Building):
    """A lobby with a poster, and a room on either side, each the other's half-turn.

    Parameters
    ----------
    seed
        Of the textures.
    """

    seed: int = 0
    panels: list[Panel] = field(init=False, repr=False)
    mesh: trimesh.Trimesh = field(init=False, repr=False)

    def __post_init__(self) -> None:
        half = _half()
        poster = Panel((-0.65, LOBBY_Y - 0.02, 0.9), (1.3, 0, 0), (0, 0, 1.2), "poster")
        self.panels = [*half, *(panel.moved(2) for panel in half), poster]
        self.mesh = mesh_of(self.panels)

    def repetitions(self, T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The pose after a half-turn, (1, 4, 4)."""
        return half_turn(T_world_cam)[None]


def _half() -> list[Panel]:
    """Half the lobby, a passage and a room, all towards +x."""
    a, b, r, d, h, top = LOBBY_X, LOBBY_Y, ROOM_X, DOOR_Y, HEIGHT, DOOR_HEIGHT
    lobby = [
        Panel((0, -b, 0), (a, 0, 0), (0, 2 * b, 0), "hall_floor"),
        Panel((0, -b, h), (a, 0, 0), (0, 2 * b, 0), "hall_ceiling"),
        Panel((0, b, 0), (a, 0, 0), (0, 0, h), "hall_wall"),
        Panel((0, -b, 0), (a, 0, 0), (0, 0, h), "hall_wall_door", (0.6, 0)),
        Panel((a, -b, 0), (0, b - d, 0), (0, 0, h), "end_east"),
        Panel((a, d, 0), (0, b - d, 0), (0, 0, h), "end_east", (b + d, 0)),
        Panel((a, -d, top), (0, 2 * d, 0), (0, 0, h - top), "end_east", (b - d, top)),
    ]
    passage = [
        Panel((a, -d, 0), (r - a, 0, 0), (0, 0, top), "jamb"),
        Panel((a, d, 0), (r - a, 0, 0), (0, 0, top), "jamb"),
        Panel((a, -d, top), (r - a, 0, 0), (0, 2 * d, 0), "jamb"),
        Panel((a, -d, 0), (r - a, 0, 0), (0, 2 * d, 0), "jamb"),
    ]
    shift = (r - ROOM_NEAR, DOOR_CENTRE, 0.0)  # a module's rooms lie towards +y
    return lobby + passage + [panel.moved(-1, shift) for panel in room(0.0)]
