"""Ray casting of the corridor world on the CPU: trimesh and Embree find the surface, NumPy shades it."""

from __future__ import annotations

import numpy as np
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conformodal.core.arrays import Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera

from .textures import N_LEVELS, TEXELS_PER_M, make_textures
from .world import Building

CAMERA = PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
# The drone carries the only lamp: beyond some 8 m nothing is seen, so far ends do not give a place away.
LAMP_RANGE_M = 3.4
CAMERA_NOISE_LEVELS = 2.0  # standard deviation, in grey levels of 255
# Two views are the same if all but this share of the pixels agree within three spreads of the camera's noise.
MAX_SHARE_DIFFERENT = 0.001
MAX_LEVEL_DIFFERENCE = 3 * CAMERA_NOISE_LEVELS


class Renderer:
    """Renders views of a world."""

    def __init__(self, world: Building, camera: PinholeCamera = CAMERA) -> None:
        self.world, self.camera = world, camera
        self._intersector = RayMeshIntersector(world.mesh)
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.column_stack((columns.ravel(), rows.ravel())).astype(np.float64)
        self._rays_cam = camera.bearings(pixels)
        panels, n_texels = world.panels, 0
        self._corner = np.array([p.corner for p in panels])
        u, v = np.array([p.u for p in panels]), np.array([p.v for p in panels])
        self._u = u / np.linalg.norm(u, axis=1, keepdims=True)
        self._v = v / np.linalg.norm(v, axis=1, keepdims=True)
        self._normal = np.cross(self._u, self._v)
        self._uv = np.array([p.uv for p in panels])
        # one long array of texels; per panel and pyramid level, where its image starts and how large it is
        starts: dict[str, list[tuple[int, int, int]]] = {}
        texels = []
        for name, levels in make_textures(world.seed).items():
            starts[name] = []
            for image in levels:
                starts[name].append((n_texels, image.shape[0], image.shape[1]))
                texels.append(image.reshape(-1, 3))
                n_texels += len(texels[-1])
        self._texels = np.concatenate(texels)
        self._image_at = np.array([starts[p.material] for p in panels])  # (panels, levels, 3)

    def render(self, T_world_cam: FloatArray, noise_seed: int | None = None) -> UInt8Array:
        """One view, (height, width, 3) RGB; `noise_seed` adds camera noise, None leaves the view exact."""
        rays = self._rays_cam @ T_world_cam[:3, :3].T
        centre = T_world_cam[:3, 3]
        face = self._intersector.intersects_first(np.broadcast_to(centre, rays.shape), rays)
        panel = np.where(face >= 0, face // 2, 0)
        normal = self._normal[panel]
        along = np.einsum("ij,ij->i", normal, rays)
        distance = np.einsum("ij,ij->i", normal, self._corner[panel] - centre) / np.where(along == 0, 1e-9, along)
        hit = centre + distance[:, None] * rays - self._corner[panel]
        u = np.einsum("ij,ij->i", hit, self._u[panel]) + self._uv[panel, 0]
        v = np.einsum("ij,ij->i", hit, self._v[panel]) + self._uv[panel, 1]
        # a pixel covers distance / (f cos) metres of the surface: choose the pyramid level that blurs as much
        footprint = distance * TEXELS_PER_M / self.camera.fx / np.sqrt(np.clip(np.abs(along), 0.1, 1.0))
        level = np.clip(np.round(np.log2(np.maximum(footprint, 1e-6))), 0, N_LEVELS - 1).astype(np.int64)
        colour = self._sample(panel, level, u, v)
        light = np.exp(-((distance / LAMP_RANGE_M) ** 2)) * (0.55 + 0.45 * np.abs(along))
        light[face < 0] = 0.0
        grey = 255.0 * colour * light[:, None]
        if noise_seed is not None:
            rng = np.random.default_rng(noise_seed)
            grey += CAMERA_NOISE_LEVELS * rng.standard_normal(grey.shape, dtype=np.float32)
        image = np.clip(np.round(grey), 0, 255).astype(np.uint8)
        return np.asarray(image.reshape(self.camera.height, self.camera.width, 3))

    def _sample(self, panel: IntArray, level: IntArray, u: FloatArray, v: FloatArray) -> Float32Array:
        """Bilinear look-up; textures repeat beyond their size."""
        at, h, w = np.moveaxis(self._image_at[panel, level], -1, 0)
        scale = TEXELS_PER_M / (1 << level)
        x, y = u * scale - 0.5, v * scale - 0.5
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        left, right, low, high = x0 % w, (x0 + 1) % w, at + (y0 % h) * w, at + ((y0 + 1) % h) * w
        texels = self._texels
        bottom = texels[low + left] * (1 - fx) + texels[low + right] * fx
        top = texels[high + left] * (1 - fx) + texels[high + right] * fx
        return np.asarray(bottom * (1 - fy) + top * fy, dtype=np.float32)


def same_views(renderer: Renderer, T_world_cam: FloatArray) -> FloatArray:
    """Other poses from which the view is the same, (m, 4, 4); the pose itself is not among them.

    Without what is unique in it the building repeats itself, so the only candidates are its repetitions; each is
    rendered without noise and compared pixel by pixel.
    """
    view = renderer.render(T_world_cam).astype(np.int16)
    alike = []
    for pose in renderer.world.repetitions(T_world_cam):
        different = (np.abs(renderer.render(pose).astype(np.int16) - view) > MAX_LEVEL_DIFFERENCE).any(axis=2)
        if different.mean() <= MAX_SHARE_DIFFERENT:
            alike.append(pose)
    return np.array(alike).reshape(-1, 4, 4)
