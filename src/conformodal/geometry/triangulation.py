"""Points from the rays of several cameras with known poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

MIN_PARALLAX_RAD = float(np.radians(2.5))
_ITERATIONS = 4
_DOUBT = 0.4  # share of the tolerance above which residuals are downweighted


class Rays(NamedTuple):
    """Rays of n corners from k cameras, corner by corner; the first ray of each is from the corner's own frame."""

    corner: IntArray  # (m,) 0 to n - 1, increasing; each is there
    number: IntArray  # (m,) of the corner that a ray goes through, among those of all frames
    camera: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1 of the camera
    R_world_cam: FloatArray  # (k, 3, 3)
    centres: FloatArray  # (k, 3)

    @property
    def first(self) -> IntArray:
        """Index (n,) of the first ray of each corner."""
        return np.flatnonzero(np.diff(self.corner, prepend=-1))


class Points(NamedTuple):
    """Points (n, 3) of corners, NaN where there is none, and which of them are reliable (n,)."""

    xyz: FloatArray
    reliable: BoolArray


def nearest_kilometres(positions_xyz: FloatArray) -> FloatArray:
    """The mean (3,) of positions (n, 3), rounded to 1000 m; zeros near the world's own origin.

    Relative to it, squares and single precision lose nothing.
    """
    return np.asarray(1000 * np.round(positions_xyz.mean(axis=0) / 1000))


def triangulate(rays: Rays, tolerance: float) -> Points:
    """Points nearest to their rays, by robust least squares over the angles between points and rays.

    A point is reliable if its own frame and another one agree on it within the tolerance (radians), it lies in front of
    both, and their rays differ by 2.5 degrees. Corners that no other camera sees near the epipolar line have no point.
    """
    origin = nearest_kilometres(rays.centres)
    R, centres = rays.R_world_cam[rays.camera], (rays.centres - origin)[rays.camera]
    local, first = np.column_stack((rays.plane, np.ones(len(rays.plane)))), rays.first
    xyz, reliable = np.full((len(first), 3), np.nan), np.zeros(len(first), dtype=np.bool_)
    kept = _off_epipolar(local, R, centres, first[rays.corner]) < tolerance
    kept &= (np.bincount(rays.corner[kept], minlength=len(first)) > 1)[rays.corner]
    if not kept.any():
        return Points(xyz, reliable)
    corners, starts, corner = np.unique(rays.corner[kept], return_index=True, return_inverse=True)
    centres = centres[kept]
    world = np.einsum("mab,mb->ma", R[kept], local[kept])
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    onto = np.eye(3) - world[:, :, None] * world[:, None]  # the plane across a ray
    across = centres - world * (world * centres).sum(axis=1, keepdims=True)
    weights = np.ones(len(world))
    for _ in range(_ITERATIONS):
        matrix = np.add.reduceat(weights[:, None, None] * onto, starts) + 1e-9 * np.eye(3)
        right = np.add.reduceat(weights[:, None] * across, starts)
        points = np.linalg.solve(matrix, right[..., None])[..., 0]
        apart = points[corner] - centres
        square, along = np.maximum((apart**2).sum(axis=1), 1e-12), (apart * world).sum(axis=1)
        off = np.sqrt(np.maximum(square - along**2, 0) / square)
        weights = 1 / square / (1 + (off / (_DOUBT * tolerance)) ** 2)
        weights /= np.maximum(np.maximum.reduceat(weights, starts), 1e-12)[corner]
    agree = (off < tolerance) & (along > 0)
    cosine = np.where(agree, (world[starts][corner] * world).sum(axis=1), 1.0)
    xyz[corners] = points + origin
    reliable[corners] = agree[starts] & (np.minimum.reduceat(cosine, starts) < np.cos(MIN_PARALLAX_RAD))
    return Points(xyz, reliable)


def _off_epipolar(local: FloatArray, R_world_cam: FloatArray, centres: FloatArray, first: IntArray) -> FloatArray:
    """Distances (m,) of rays from the epipolar line of their corner's `first` (m,) ray, on the plane at depth 1."""
    baseline = np.einsum("mba,mb->ma", R_world_cam, centres[first] - centres)
    turned = np.einsum("mba,mb->ma", R_world_cam, np.einsum("mab,mb->ma", R_world_cam[first], local[first]))
    line = np.cross(baseline, turned)
    return np.asarray(np.abs((line * local).sum(axis=1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12))
