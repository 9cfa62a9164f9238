"""What buildings are made of: textured rectangles, and the poses from which a building repeats itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Panel:
    """A textured rectangle: a corner, two edges (right-angled), a material, and where on it the corner lies."""

    corner: Vector
    u: Vector
    v: Vector
    material: str
    uv: tuple[float, float] = (0.0, 0.0)


class Building(ABC):
    """A world that can be rendered.

    Attributes
    ----------
    seed
        Of its textures.
    panels, mesh
        What it is made of; panel i is faces 2 i and 2 i + 1 of the mesh.
    """

    seed: int
    panels: list[Panel]
    mesh: trimesh.Trimesh

    @abstractmethod
    def repetitions(self, T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Other poses (m, 4, 4) from which the view would be the same if nothing in the building were unique."""

    def plan(self) -> list[npt.NDArray[np.float64]]:
        """Walls as seen from above: (2, 2) segments of x, y."""
        segments = []
        for panel in self.panels:
            corner, u, v = np.array(panel.corner), np.array(panel.u), np.array(panel.v)
            upright = abs(v[2]) > 0 and panel.corner[2] < 1.0
            if upright and u[2] == 0:
                segments.append(np.array([corner[:2], (corner + u)[:2]]))
        return segments


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


def mesh_of(panels: Sequence[Panel]) -> trimesh.Trimesh:
    """Two triangles a panel."""
    corner = np.array([p.corner for p in panels])
    u, v = np.array([p.u for p in panels]), np.array([p.v for p in panels])
    vertices = np.stack((corner, corner + u, corner + u + v, corner + v), axis=1).reshape(-1, 3)
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (quad[None] + 4 * np.arange(len(panels))[:, None, None]).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)
