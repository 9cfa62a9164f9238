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
from scipy.spatial.transform import Rotation

from conformodal.corridor.flight import Waypoint, fly
from conformodal.corridor.world import (  # fmt: skip
    DOOR_CENTRE,
    DOOR_HEIGHT,
    HEIGHT,
    ROOM_NEAR,
    Building,
    Panel,
    Vector,
    room,
)
from conformodal.geometry import Trajectory

LOBBY_X, LOBBY_Y = 0.9, 2.6  # half its length and width
ROOM_X = 2.1  # where the passage ends and the room begins
DOOR_Y = 0.6  # half the width of the passage


@dataclass
class TurnedRooms(Building):
    """A lobby with a poster, and a room on either side, each the other's half-turn; the seed is of the textures."""

    seed: int = 0
    panels: list[Panel] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        half = _half()
        poster = Panel((-0.65, LOBBY_Y - 0.02, 0.9), (1.3, 0, 0), (0, 0, 1.2), "poster")
        self.panels = [*half, *(_moved(panel, 2) for panel in half), poster]

    def repetitions(self, T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The pose after a half-turn, (1, 4, 4)."""
        return half_turn(T_world_cam)[None]


def half_turn(T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A pose (4, 4) turned by 180 degrees about the z axis of the world."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix().round()
    return np.asarray(turn @ T_world_cam)


def visiting_path(n_visits: int = 12, seed: int = 0) -> Trajectory:
    """Poses ``T_world_cam`` of a flight through :class:`TurnedRooms`, seeded, at 10 frames a second.

    Each visit starts in the middle of the lobby, looks at the poster's wall or at the one opposite, turns to one of the
    rooms, flies in, looks around, backs out and turns away. Wall and room are random in the first half of the flight;
    the second half is the half-turn of the first, so that whatever is seen on one side is seen on the other as often.
    An odd number of visits is rounded up.
    """
    rng = np.random.default_rng(seed)
    half = [(rng.choice((90.0, -90.0)), rng.choice((0.0, 180.0))) for _ in range((n_visits + 1) // 2)]
    waypoints: list[Waypoint] = []
    for wall, side in [*half, *((wall + 180.0, side + 180.0) for wall, side in half)]:
        sign = 1.0 if side % 360.0 == 0.0 else -1.0
        ahead = [(0.0, 0.0, 0.0), (ROOM_X + 0.4, 0.0, 0.0), (ROOM_X + 1.2, 0.4, 55.0), (ROOM_X + 1.2, -0.4, -55.0)]
        waypoints.append((0.0, 0.0, wall))
        waypoints += [(sign * x, sign * y, yaw + side) for x, y, yaw in [*ahead, *ahead[1::-1]]]
    waypoints.append((0.0, 0.0, half[0][0]))
    yaw = np.degrees(np.unwrap(np.radians([point[2] for point in waypoints])))
    return fly([(x, y, turned) for (x, y, _), turned in zip(waypoints, yaw.tolist(), strict=True)], rng)


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
    return lobby + passage + [_moved(panel, -1, shift) for panel in room(0.0)]


def _moved(panel: Panel, quarter_turns: int, shift: Vector = (0.0, 0.0, 0.0)) -> Panel:
    """Turned about the z axis by a number of quarter turns, then shifted."""
    corner, u, v = (_turned(vector, quarter_turns) for vector in (panel.corner, panel.u, panel.v))
    x, y, z = (a + b for a, b in zip(corner, shift, strict=True))
    return Panel((x, y, z), u, v, panel.material, panel.uv)


def _turned(vector: Vector, quarters: int) -> Vector:
    x, y, z = vector
    for _ in range(quarters % 4):
        x, y = -y, x
    return (x, y, z)
