"""Points from the rays of several cameras with known poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

MIN_PARALLAX_RAD = float(np.radians(2.5))
_ITERATIONS = 4
# the upper triangle of a symmetric matrix, row by row; where it lies on the diagonal, and where each entry comes from
_ROWS, _COLUMNS = np.triu_indices(3)
_DIAGONAL, _SYMMETRIC = [0, 3, 5], np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
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


def local_origin(positions_xyz: FloatArray) -> FloatArray:
    """The mean (3,) of positions (n, 3), rounded to 1000 m; zeros near the world's own origin.

    Relative to it, squares and single precision lose nothing.
    """
    return np.asarray(1000 * np.round(positions_xyz.mean(axis=0) / 1000))


def triangulate(rays: Rays, tolerance: float) -> Points:
    """Points nearest to their rays, by robust least squares over the angles between points and rays.

    A point is reliable if its own frame and another one agree on it within the tolerance (radians), it lies in front of
    both, and their rays differ by 2.5 degrees. Corners that no other camera sees near the epipolar line have no point.
    """
    origin = local_origin(rays.centres)
    # row by row, take is several times as fast as an index array
    right, down, ahead = (rays.R_world_cam[:, :, k].take(rays.camera, axis=0) for k in range(3))
    centres, first = (rays.centres - origin).take(rays.camera, axis=0), rays.first
    world = rays.plane[:, :1] * right + rays.plane[:, 1:] * down + ahead
    xyz, reliable = np.full((len(first), 3), np.nan), np.zeros(len(first), dtype=np.bool_)
    kept = _off_epipolar(world, right, down, centres, first.take(rays.corner)) < tolerance
    kept &= (np.bincount(rays.corner[kept], minlength=len(first)) > 1).take(rays.corner)
    if not kept.any():
        return Points(xyz, reliable)
    corners, starts, corner = np.unique(rays.corner[kept], return_index=True, return_inverse=True)
    centres, world = centres[kept], world[kept]
    world /= np.sqrt(_dot(world, world))[:, None]
    # the plane across a ray, as the upper triangle of a matrix, and the centre's part in it
    equations = np.column_stack((-world.take(_ROWS, axis=1) * world.take(_COLUMNS, axis=1), centres))
    equations[:, _DIAGONAL] += 1
    equations[:, 6:] -= world * _dot(world, centres)[:, None]
    weights, bounds = np.ones(len(world)), np.append(starts, len(world))
    for _ in range(_ITERATIONS):
        # a row for each corner, which weighs its rays: the product is faster than sums by reduceat
        by_corner = csr_array((weights, np.arange(len(world)), bounds), shape=(len(corners), len(world)))
        sums = by_corner @ equations
        points = np.linalg.solve(sums[:, _SYMMETRIC] + 1e-9 * np.eye(3), sums[:, 6:, None])[..., 0]
        apart = points.take(corner, axis=0) - centres
        square, along = np.maximum(_dot(apart, apart), 1e-12), _dot(apart, world)
        off = np.sqrt(np.maximum(square - along**2, 0) / square)
        weights = 1 / square / (1 + (off / (_DOUBT * tolerance)) ** 2)
        weights /= np.maximum(np.maximum.reduceat(weights, starts), 1e-12).take(corner)
    agree = (off < tolerance) & (along > 0)
    cosine = np.where(agree, _dot(world[starts].take(corner, axis=0), world), 1.0)
    xyz[corners] = points + origin
    reliable[corners] = agree[starts] & (np.minimum.reduceat(cosine, starts) < np.cos(MIN_PARALLAX_RAD))
    return Points(xyz, reliable)


def _off_epipolar(
    world: FloatArray, right: FloatArray, down: FloatArray, centres: FloatArray, first: IntArray
) -> FloatArray:
    """Distances (m,) of rays from the epipolar line of their corner's `first` (m,) ray, on the plane at depth 1.

    `world` (m, 3) are rays in the world that reach this plane; `right` and `down` the axes of their cameras.
    """
    normal = np.cross(centres.take(first, axis=0) - centres, world.take(first, axis=0))
    line = np.hypot(_dot(right, normal), _dot(down, normal))
    return np.asarray(np.abs(_dot(normal, world)) / np.maximum(line, 1e-12))


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    """Products (m,) of vectors (m, 3), row by row."""
    return np.asarray(np.einsum("ij,ij->i", one, other))
