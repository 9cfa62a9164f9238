"""Points from the rays of several cameras with known poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.localization.settings import MAPPING


class Rays(NamedTuple):
    """n corners as k cameras see them; they are corners of the first camera's frame."""

    plane: FloatArray  # (n, k, 2) on the plane at depth 1 of each camera, where seen
    seen: BoolArray  # (n, k)
    R_world_cam: FloatArray  # (k, 3, 3)
    centres: FloatArray  # (k, 3)


def triangulate(rays: Rays, tolerance: float) -> tuple[FloatArray, BoolArray]:
    """Points (n, 3) nearest to their rays, and which of them (n,) are reliable.

    Robust least squares over the angles between points and rays. A point is reliable if the first camera and another
    one agree on it within the tolerance (radians), it lies in front of both, and their rays differ by 2.5 degrees.
    """
    n, k = rays.seen.shape
    local = np.concatenate((rays.plane, np.ones((n, k, 1))), axis=2)
    seen = rays.seen & (_off_epipolar(rays, local) < tolerance)
    world = _each(local, rays.R_world_cam.transpose(0, 2, 1))
    world /= np.linalg.norm(world, axis=2, keepdims=True)
    # I - w w' projects onto the plane across a ray
    across = rays.centres - world * (world * rays.centres).sum(axis=2, keepdims=True)
    weights = seen.astype(np.float64)
    for _ in range(MAPPING.iterations):
        matrix = (weights.sum(axis=1) + 1e-9)[:, None, None] * np.eye(3)
        matrix -= (weights[..., None] * world).transpose(0, 2, 1) @ world
        right = weights[:, None] @ across
        points = np.linalg.solve(matrix, right.transpose(0, 2, 1))[..., 0]
        apart = points[:, None] - rays.centres
        square, along = (apart**2).sum(axis=2), (apart * world).sum(axis=2)
        square = np.maximum(square, 1e-12)
        off = np.sqrt(np.maximum(square - along**2, 0) / square)
        weights = seen / square / (1 + (off / (MAPPING.doubt * tolerance)) ** 2)
        weights /= np.maximum(weights.max(axis=1, keepdims=True), 1e-12)
    agree = seen & (off < tolerance) & (along > 0)
    cosine = np.where(agree, (world[:, :1] * world).sum(axis=2), 1.0).min(axis=1)
    return points, agree[:, 0] & (cosine < np.cos(MAPPING.min_parallax_rad))


def _off_epipolar(rays: Rays, local: FloatArray) -> FloatArray:
    """(n, k) distances from the epipolar line of the first camera's ray, on the plane at depth 1; 0 for the first."""
    baseline = np.einsum("kba,kb->ka", rays.R_world_cam, rays.centres[0] - rays.centres)
    turned = ((local[:, 0] @ rays.R_world_cam[0].T) @ rays.R_world_cam).transpose(1, 0, 2)
    line = np.cross(baseline, turned)
    return np.asarray(np.abs((line * local).sum(axis=2)) / np.maximum(np.linalg.norm(line[..., :2], axis=2), 1e-12))


def _each(vectors: FloatArray, matrices: FloatArray) -> FloatArray:
    """Rows (n, k, 3) times the matrix of their camera (k, 3, 3)."""
    return (vectors.transpose(1, 0, 2) @ matrices).transpose(1, 0, 2)
