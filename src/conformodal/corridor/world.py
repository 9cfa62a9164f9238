"""Geometry of the corridor world: textured rectangles.

A hallway runs along x. Every `MODULE_LENGTH` metres the same module repeats: a closed door on one side, an open
doorway into a furnished room on the other. A few one-off landmarks break the repetition. Frame: x along the hall,
y across it towards the rooms, z up; metres; the floor is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh

from conformodal.core.arrays import FloatArray
from conformodal.io.errors import DatasetError

Vector = tuple[float, float, float]
MODULE_LENGTH = 4.0
HALL_WIDTH = 2.2
HEIGHT = 2.6
ROOM_NEAR, ROOM_FAR = 2.35, 5.6  # y
ROOM_LEFT, ROOM_RIGHT = 0.25, 3.75  # x within the module
DOOR_LEFT, DOOR_RIGHT, DOOR_HEIGHT = 1.4, 2.6, 2.1
DOOR_CENTRE = (DOOR_LEFT + DOOR_RIGHT) / 2


@dataclass(frozen=True)
class Panel:
    """A textured rectangle: a corner, two edges (right-angled), a material, and where on it the corner lies."""

    corner: Vector
    u: Vector
    v: Vector
    material: str
    uv: tuple[float, float] = (0.0, 0.0)


def box(corner: Vector, size: Vector, material: str) -> list[Panel]:
    """Sides and top of a box that stands on the floor."""
    (x, y, z), (a, b, c) = corner, size
    return [
        Panel((x, y, z), (a, 0, 0), (0, 0, c), material),
        Panel((x, y + b, z), (a, 0, 0), (0, 0, c), material),
        Panel((x, y, z), (0, b, 0), (0, 0, c), material),
        Panel((x + a, y, z), (0, b, 0), (0, 0, c), material),
        Panel((x, y, z + c), (a, 0, 0), (0, b, 0), material),
    ]


@dataclass
class CorridorWorld:
    """A hallway of `n_modules` identical modules and the landmarks that tell some apart."""

    n_modules: int = 5
    seed: int = 0  # of its textures
    rearranged: bool = False  # whether desks and shelves have changed places and the poster is gone
    panels: list[Panel] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.n_modules < 2:
            raise DatasetError(f"n_modules must be at least 2, got {self.n_modules}")
        self.panels = [p for k in range(self.n_modules) for p in _module(k * MODULE_LENGTH, self.rearranged)]
        self.panels += [
            Panel((0, 0, 0), (0, HALL_WIDTH, 0), (0, 0, HEIGHT), "end_west"),
            Panel((self.length, 0, 0), (0, HALL_WIDTH, 0), (0, 0, HEIGHT), "end_east"),
        ]
        landmarks = _landmarks(self.n_modules)
        self.panels += landmarks[1:] if self.rearranged else landmarks

    @property
    def length(self) -> float:
        """Length of the hall in metres."""
        return self.n_modules * MODULE_LENGTH

    @property
    def mesh(self) -> trimesh.Trimesh:
        """Two triangles per panel: panel i is faces 2 i and 2 i + 1."""
        corner, u, v = (np.array([getattr(p, name) for p in self.panels]) for name in ("corner", "u", "v"))
        vertices = np.stack((corner, corner + u, corner + u + v, corner + v), axis=1).reshape(-1, 3)
        quad = np.array([[0, 1, 2], [0, 2, 3]])
        faces = (quad[None] + 4 * np.arange(len(self.panels))[:, None, None]).reshape(-1, 3)
        return trimesh.Trimesh(vertices, faces, process=False)

    def plan(self) -> list[FloatArray]:
        """Walls as seen from above: (2, 2) segments of x, y."""
        upright = [p for p in self.panels if p.v[2] > 0 and p.u[2] == 0 and p.corner[2] < 1.0]
        return [np.array([p.corner[:2], (p.corner[0] + p.u[0], p.corner[1] + p.u[1])]) for p in upright]

    def repetitions(self, T_world_cam: FloatArray) -> FloatArray:
        """The pose moved by whole modules (n_modules - 1, 4, 4), where the view would be the same but for landmarks."""
        place = int(T_world_cam[0, 3] // MODULE_LENGTH)
        moves = [k for k in range(-place, self.n_modules - place) if k]
        poses = np.tile(T_world_cam, (len(moves), 1, 1))
        poses[:, 0, 3] += MODULE_LENGTH * np.array(moves)
        return poses


def _module(x: float, rearranged: bool) -> list[Panel]:
    h, w, p = HEIGHT, HALL_WIDTH, MODULE_LENGTH
    left, right = x + DOOR_LEFT, x + DOOR_RIGHT
    opening = right - left
    return [
        Panel((x, 0, 0), (p, 0, 0), (0, w, 0), "hall_floor"),
        Panel((x, 0, h), (p, 0, 0), (0, w, 0), "hall_ceiling"),
        Panel((x, 0, 0), (p, 0, 0), (0, 0, h), "hall_wall_door"),
        # the wall with the open doorway, seen from the hall
        Panel((x, w, 0), (DOOR_LEFT, 0, 0), (0, 0, h), "hall_wall"),
        Panel((right, w, 0), (p - DOOR_RIGHT, 0, 0), (0, 0, h), "hall_wall", (DOOR_RIGHT, 0)),
        Panel((left, w, DOOR_HEIGHT), (opening, 0, 0), (0, 0, h - DOOR_HEIGHT), "hall_wall", (DOOR_LEFT, DOOR_HEIGHT)),
        # the thickness of that wall
        Panel((left, w, 0), (0, ROOM_NEAR - w, 0), (0, 0, DOOR_HEIGHT), "jamb"),
        Panel((right, w, 0), (0, ROOM_NEAR - w, 0), (0, 0, DOOR_HEIGHT), "jamb"),
        Panel((left, w, DOOR_HEIGHT), (opening, 0, 0), (0, ROOM_NEAR - w, 0), "jamb"),
        Panel((left, w, 0), (opening, 0, 0), (0, ROOM_NEAR - w, 0), "jamb"),
        *room(x, rearranged),
    ]


def room(x: float, rearranged: bool = False) -> list[Panel]:
    """The furnished room of the module that starts at x."""
    x0, x1, y0, y1, h = x + ROOM_LEFT, x + ROOM_RIGHT, ROOM_NEAR, ROOM_FAR, HEIGHT
    left, right = x + DOOR_LEFT, x + DOOR_RIGHT
    wide, deep = x1 - x0, y1 - y0
    desk, shelf = ((x0, y1 - 0.7, 0), (x1 - 0.4, y1 - 1.9, 0))
    if rearranged:
        desk, shelf = ((x1 - 1.3, y1 - 0.7, 0), (x0, y0 + 0.4, 0))
    return [
        Panel((x0, y0, 0), (wide, 0, 0), (0, deep, 0), "room_floor"),
        Panel((x0, y0, h), (wide, 0, 0), (0, deep, 0), "room_ceiling"),
        Panel((x0, y1, 0), (wide, 0, 0), (0, 0, h), "room_back"),
        Panel((x0, y0, 0), (0, deep, 0), (0, 0, h), "room_left"),
        Panel((x1, y0, 0), (0, deep, 0), (0, 0, h), "room_right"),
        Panel((x0, y0, 0), (left - x0, 0, 0), (0, 0, h), "room_near"),
        Panel((right, y0, 0), (x1 - right, 0, 0), (0, 0, h), "room_near", (right - x0, 0)),
        Panel((left, y0, DOOR_HEIGHT), (right - left, 0, 0), (0, 0, h - DOOR_HEIGHT), "room_near", (left - x0, 2.1)),
        *box(desk, (1.3, 0.7, 0.75), "desk"),
        *box(shelf, (0.4, 1.1, 1.7), "shelf"),
    ]


def _landmarks(n_modules: int) -> list[Panel]:
    """One-off things: a poster in a room, a cabinet and a painting in the hall, a crate in another room."""
    second, last = MODULE_LENGTH, (n_modules - 1) * MODULE_LENGTH
    middle = (n_modules // 2) * MODULE_LENGTH
    return [
        Panel((second + 1.7, ROOM_FAR - 0.02, 0.9), (1.3, 0, 0), (0, 0, 1.2), "poster"),
        Panel((middle + 3.1, 0.02, 0.9), (0.8, 0, 0), (0, 0, 1.0), "painting"),
        *box((last + 0.2, HALL_WIDTH - 0.45, 0), (0.5, 0.4, 1.1), "cabinet"),
    ]
