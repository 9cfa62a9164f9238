"""Ray casting of the corridor world on the CPU: trimesh and Embree find the surface, NumPy shades it.

Textures are procedural: seeded, metric, rich in corners for a tracker to hold on to.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from trimesh.ray.ray_pyembree import RayMeshIntersector

from conformodal.core.arrays import Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera

from .world import DOOR_CENTRE, CorridorWorld

CAMERA = PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=59.5, width=160, height=120)
# The drone carries the only lamp: beyond some 8 m nothing is seen, so far ends do not give a place away.
LAMP_RANGE_M = 3.4
CAMERA_NOISE_LEVELS = 2.0  # standard deviation, in grey levels of 255
TEXELS_PER_M = 64
N_LEVELS = 5  # of the image pyramid against aliasing; each halves the resolution


# material: (width m, height m, base colour 0..1, strength of the speckle)
MATERIALS: dict[str, tuple[float, float, tuple[float, float, float], float]] = {
    "hall_floor": (4.0, 2.2, (0.42, 0.40, 0.38), 0.10),
    "hall_ceiling": (4.0, 2.2, (0.75, 0.75, 0.72), 0.05),
    "hall_wall": (4.0, 2.6, (0.70, 0.68, 0.58), 0.07),
    "hall_wall_door": (4.0, 2.6, (0.70, 0.68, 0.58), 0.07),
    "jamb": (1.2, 2.1, (0.45, 0.30, 0.18), 0.08),
    "room_floor": (3.5, 3.25, (0.50, 0.36, 0.24), 0.10),
    "room_ceiling": (3.5, 3.25, (0.70, 0.72, 0.75), 0.05),
    "room_back": (3.5, 2.6, (0.55, 0.65, 0.72), 0.08),
    "room_left": (3.25, 2.6, (0.62, 0.66, 0.60), 0.08),
    "room_right": (3.25, 2.6, (0.66, 0.60, 0.62), 0.08),
    "room_near": (3.5, 2.6, (0.60, 0.60, 0.55), 0.08),
    "desk": (1.3, 0.75, (0.55, 0.40, 0.25), 0.10),
    "shelf": (1.1, 1.7, (0.35, 0.30, 0.40), 0.15),
    "end_west": (2.2, 2.6, (0.30, 0.50, 0.35), 0.10),
    "end_east": (2.2, 2.6, (0.60, 0.35, 0.25), 0.10),
    "poster": (1.3, 1.2, (0.85, 0.80, 0.20), 0.25),
    "painting": (0.8, 1.0, (0.20, 0.35, 0.75), 0.25),
    "cabinet": (0.5, 1.1, (0.80, 0.12, 0.10), 0.15),
}
_TILED = {"hall_floor": 0.55, "hall_ceiling": 1.0, "room_floor": 0.3, "room_ceiling": 0.9, "end_west": 0.35}
_STICKERS = {"room_back": 9, "room_left": 6, "room_right": 6, "room_near": 4, "shelf": 14, "desk": 3}
_STICKERS |= {"hall_wall": 5, "hall_wall_door": 4, "end_east": 8, "poster": 10, "painting": 10, "cabinet": 4}


class Renderer:
    """Renders views of a world."""

    def __init__(self, world: CorridorWorld, camera: PinholeCamera = CAMERA) -> None:
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
        # (panels * levels,) each
        self._starts, self._heights, self._widths = (
            np.array([starts[p.material] for p in panels]).reshape(-1, 3).T.copy()
        )

    def render(self, T_world_cam: FloatArray, noise_seed: int | None = None) -> UInt8Array:
        """One view, (height, width, 3) RGB; `noise_seed` adds camera noise, None leaves the view exact."""
        rays = self._rays_cam @ T_world_cam[:3, :3].T
        centre = T_world_cam[:3, 3]
        face = self._intersector.intersects_first(np.broadcast_to(centre, rays.shape), rays)
        panel = np.where(face >= 0, face // 2, 0)
        normal, corner = self._normal.take(panel, axis=0), self._corner.take(panel, axis=0)
        along = np.einsum("ij,ij->i", normal, rays)
        distance = np.einsum("ij,ij->i", normal, corner - centre) / np.where(along == 0, 1e-9, along)
        hit = centre + distance[:, None] * rays - corner
        u = np.einsum("ij,ij->i", hit, self._u.take(panel, axis=0)) + self._uv[:, 0].take(panel)
        v = np.einsum("ij,ij->i", hit, self._v.take(panel, axis=0)) + self._uv[:, 1].take(panel)
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
        image = panel * N_LEVELS + level
        at, h, w = self._starts.take(image), self._heights.take(image), self._widths.take(image)
        scale = TEXELS_PER_M / (1 << level)
        x, y = u * scale - 0.5, v * scale - 0.5
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        left, right, low, high = x0 % w, (x0 + 1) % w, at + (y0 % h) * w, at + ((y0 + 1) % h) * w
        texels = self._texels
        # take is several times as fast as an index array
        bottom = texels.take(low + left, axis=0) * (1 - fx) + texels.take(low + right, axis=0) * fx
        top = texels.take(high + left, axis=0) * (1 - fx) + texels.take(high + right, axis=0) * fx
        return np.asarray(bottom * (1 - fy) + top * fy, dtype=np.float32)


def make_textures(seed: int) -> dict[str, list[Float32Array]]:
    """Every material's pyramid: `N_LEVELS` images (h, w, 3) in [0, 1], finest first.

    Row 0 of an image is the bottom of an upright surface.
    """
    rng = np.random.default_rng(seed)
    return {name: _pyramid(_draw(name, rng)) for name in MATERIALS}


def _draw(name: str, rng: np.random.Generator) -> Float32Array:
    width, height, colour, speckle = MATERIALS[name]
    h, w = round(height * TEXELS_PER_M), round(width * TEXELS_PER_M)
    image = np.empty((h, w, 3), dtype=np.float32)
    image[:] = colour
    for sigma in (1.0, 3.0, 10.0):
        noise = gaussian_filter(rng.standard_normal((h, w)), sigma, mode="wrap")
        image += (speckle / 2 * noise / noise.std())[..., None].astype(np.float32)
    if name in _TILED:
        tile = max(4, round(_TILED[name] * TEXELS_PER_M))
        rows, cols = np.arange(h) // tile, np.arange(w) // tile
        shade = rng.uniform(-0.1, 0.1, (rows[-1] + 1, cols[-1] + 1)).astype(np.float32)
        image += shade[rows][:, cols][..., None]
        image[np.arange(h) % tile < 2] *= 0.6
        image[:, np.arange(w) % tile < 2] *= 0.6
    if name.startswith("hall_wall"):
        image[: round(0.12 * TEXELS_PER_M)] *= 0.5  # skirting
        image[round(1.0 * TEXELS_PER_M) : round(1.08 * TEXELS_PER_M)] *= (0.6, 0.7, 0.9)
    if name == "hall_wall_door":
        _closed_door(image, rng)
    for _ in range(_STICKERS.get(name, 0)):
        _sticker(image, rng, largest=0.35 if name not in ("poster", "painting") else 0.5)
    return np.clip(image, 0.02, 1.0).astype(np.float32)


def _closed_door(image: Float32Array, rng: np.random.Generator) -> None:
    t = TEXELS_PER_M
    a, b, top = round((DOOR_CENTRE - 0.5) * t), round((DOOR_CENTRE + 0.5) * t), round(2.05 * t)
    grain = gaussian_filter(rng.standard_normal((top, b - a)), (8, 1)).astype(np.float32)
    image[:top, a:b] = np.array([0.42, 0.26, 0.14], np.float32) + 0.5 * grain[..., None]
    image[:top, [a, a + 1, a + 2, b - 3, b - 2, b - 1]] *= 0.4
    for low, high in ((0.2, 0.9), (1.15, 1.85)):
        image[round(low * t) : round(high * t), a + 12 : b - 12] *= 0.75
    image[round(1.0 * t) : round(1.08 * t), b - 12 : b - 4] = (0.9, 0.85, 0.5)  # handle


def _sticker(image: Float32Array, rng: np.random.Generator, largest: float) -> None:
    """A coloured rectangle with a two-tone pattern: a switch, a notice, a book."""
    h, w = image.shape[:2]
    sh, sw = (max(4, round(rng.uniform(0.1, largest) * TEXELS_PER_M)) for _ in range(2))
    sh, sw = min(sh, h - 2), min(sw, w - 2)
    y, x = int(rng.integers(0, h - sh)), int(rng.integers(0, w - sw))
    image[y : y + sh, x : x + sw] = rng.uniform(0.05, 1.0, 3)
    image[y + sh // 3 : y + 2 * sh // 3, x + sw // 4 : x + sw // 2] = rng.uniform(0.05, 1.0, 3)


def _pyramid(image: Float32Array) -> list[Float32Array]:
    levels = [image]
    for _ in range(N_LEVELS - 1):
        fine = levels[-1]
        even = fine[: max(2, fine.shape[0] // 2 * 2), : max(2, fine.shape[1] // 2 * 2)]
        mean = (even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]) / 4
        levels.append(mean.astype(np.float32))
    return levels
