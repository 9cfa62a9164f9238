"""Bundle adjustment of a few cameras and the corners of the first, the anchor (Triggs et al. 2000).

A corner is parametrised by its inverse depth in the anchor (Civera et al. 2008), which is well behaved far away. It is
one unknown, so the Schur complement that removes all corners divides by numbers instead of matrices.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.robust import MEDIAN_OF_NORM2
from conformodal.geometry import cross_matrices

from .settings import BUNDLE


class Bundle(NamedTuple):
    """Cameras and corners, in the anchor's frame and up to scale."""

    R_anchor_frame: FloatArray  # (k, 3, 3), the cameras but the anchor
    positions: FloatArray  # (k, 3)
    inverse_depths: FloatArray  # (n,) of the corners, seen from the anchor


class Views(NamedTuple):
    """Where corners are seen, on the plane at depth 1 of each camera."""

    anchor: FloatArray  # (n, 2)
    others: FloatArray  # (k, n, 2); meaningless where `seen` is False
    seen: BoolArray  # (k, n)


def adjust_bundle(start: Bundle, views: Views, sigma: float) -> tuple[Bundle, FloatArray]:
    """Cameras and corners that fit the views best: Levenberg-Marquardt with Cauchy weights.

    `sigma` is the standard deviation of a corner on the plane at depth 1. Returns the bundle, scaled so that its last
    camera is at distance 1, and the lengths (k, n) of the residuals on the plane at depth 1, NaN where nothing was
    seen.
    """
    now, damping = start, 1e-4
    seen_from, residuals = _residuals(now, views, sigma)
    cost = _cost(residuals)
    for _ in range(BUNDLE.iterations):
        system = _linearise(now, views, seen_from, residuals, sigma)
        for _ in range(BUNDLE.dampings):
            after = _step(now, system, damping)
            seen_after, residuals_after = _residuals(after, views, sigma)
            cost_after = _cost(residuals_after)
            if cost_after <= cost:
                damping = max(damping / 10, 1e-10)
                break
            damping *= 10
        else:
            break
        enough = cost - cost_after <= BUNDLE.enough * cost
        now, seen_from, residuals, cost = after, seen_after, residuals_after, cost_after
        if enough:
            break
    length = max(float(np.linalg.norm(now.positions[-1])), 1e-12)
    lengths = np.where(views.seen, np.linalg.norm(residuals, axis=2) * sigma, np.nan)
    return Bundle(now.R_anchor_frame, now.positions / length, now.inverse_depths * length), lengths


def residual_spread(lengths: FloatArray) -> float:
    """Spread per axis of residuals in the plane, from the median of their lengths."""
    return float(np.nanmedian(lengths)) / MEDIAN_OF_NORM2


class _System(NamedTuple):
    """Normal equations: cameras (k, 6, 6), corners (n,), between them (6 k, n), and both gradients."""

    cameras: FloatArray
    corners: FloatArray
    between: FloatArray
    pull_cameras: FloatArray
    pull_corners: FloatArray


def _residuals(bundle: Bundle, views: Views, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Corners as the cameras see them times their inverse depths (k, n, 3), and residuals (k, n, 2) in spreads."""
    rays = np.column_stack((views.anchor, np.ones(len(views.anchor))))
    from_camera = rays[None] - bundle.inverse_depths[None, :, None] * bundle.positions[:, None]
    seen_from = from_camera @ bundle.R_anchor_frame
    ahead = np.maximum(seen_from[..., 2:], BUNDLE.nearest)
    return seen_from, np.where(views.seen[..., None], (seen_from[..., :2] / ahead - views.others) / sigma, 0.0)


def _cost(residuals: FloatArray) -> float:
    squares = (residuals**2).sum(axis=2) / (2 * BUNDLE.cauchy**2)
    return float(np.log1p(squares).sum())


def _linearise(bundle: Bundle, views: Views, seen_from: FloatArray, residuals: FloatArray, sigma: float) -> _System:
    k, n = views.seen.shape
    weight = np.where(views.seen, 1 / (1 + (residuals**2).sum(axis=2) / (2 * BUNDLE.cauchy**2)), 0.0)
    root = np.sqrt(weight)[..., None]
    x, y, z = (seen_from[..., i] for i in range(3))
    ahead = np.maximum(z, BUNDLE.nearest)
    scale = np.sqrt(weight) / (sigma * ahead)
    projected = np.zeros((k, n, 2, 3))  # by the corner's place in the camera's frame
    projected[..., 0, 0] = projected[..., 1, 1] = scale
    projected[..., 0, 2], projected[..., 1, 2] = -scale * x / ahead, -scale * y / ahead
    # R exp(d) moves what the camera sees by its cross product with d
    cross = cross_matrices(seen_from)
    back = np.swapaxes(bundle.R_anchor_frame, 1, 2)
    by_position = -bundle.inverse_depths[None, :, None, None] * (projected @ back[:, None])
    by_camera = np.concatenate((projected @ cross, by_position), axis=3).reshape(k, 2 * n, 6)
    by_corner = -(projected @ (back @ bundle.positions[..., None])[:, None])[..., 0]
    weighted = residuals * root
    between = (by_camera.reshape(k, n, 2, 6) * by_corner[..., None]).sum(axis=2)
    return _System(
        cameras=np.swapaxes(by_camera, 1, 2) @ by_camera,
        corners=(by_corner**2).sum(axis=(0, 2)),
        between=np.swapaxes(between, 1, 2).reshape(6 * k, n),
        pull_cameras=(np.swapaxes(by_camera, 1, 2) @ weighted.reshape(k, 2 * n, 1)).ravel(),
        pull_corners=(by_corner * weighted).sum(axis=(0, 2)),
    )


def _step(bundle: Bundle, system: _System, damping: float) -> Bundle:
    k = len(bundle.positions)
    corners = system.corners * (1 + damping) + 1e-9
    full: FloatArray = np.zeros((6 * k, 6 * k))
    for i, block in enumerate(system.cameras):
        full[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = block
    diagonal: Any = np.arange(6 * k)
    full[diagonal, diagonal] *= 1 + damping
    full[diagonal, diagonal] += 1e-9
    through = system.between / corners
    cameras = -np.linalg.solve(full - through @ system.between.T, system.pull_cameras - through @ system.pull_corners)
    move = -(system.pull_corners + system.between.T @ cameras) / corners
    turn, shift = np.split(cameras.reshape(k, 6), 2, axis=1)
    turned = Rotation.from_matrix(bundle.R_anchor_frame) * Rotation.from_rotvec(turn)
    return Bundle(turned.as_matrix(), bundle.positions + shift, bundle.inverse_depths + move)
