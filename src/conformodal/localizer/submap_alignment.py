"""Alignment of submaps with the world: terms of the least squares problem that smooths positions.

A submap is a piece of the path in a frame of its own. Seven unknowns align it: its start, its scale, and a small
rotation of its anchor. With orientations known, all are linear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Submap, matrix_from_quat_wxyz

from .prior import MotionPrior
from .settings import SMOOTHER

_UNKNOWNS = 7  # start (3), scale, rotation (3)


class SubmapAlignment:
    """Submaps of n frames with orientations (n, 4); the prior gives the depths to expect, and so the scales.

    Attributes
    ----------
    rows
        Sparse (m, 3 n + 7 submaps): position minus the submap's position, metres.
    weights
        (m,) one over the variances.
    """

    def __init__(self, submaps: Sequence[Submap], quats_wxyz: FloatArray, prior: MotionPrior) -> None:
        self._expected = prior.depth_m / np.array([s.depth for s in submaps])
        # errors of consecutive positions are correlated: all together say little more of the scale than one of them
        spread = prior.depth_spread / np.sqrt([s.span for s in submaps])
        self._spread, self._scale = spread, self._expected.copy()
        blocks, variances = [], []
        for submap, unit in zip(submaps, self._expected, strict=True):
            path = submap.positions @ matrix_from_quat_wxyz(quats_wxyz[submap.frames[:1]])[0].T
            start = np.broadcast_to(-np.eye(3), (len(path), 3, 3))
            # a rotation by w about the anchor moves a point v by w x v = -[v]x w
            cross = np.cross(np.eye(3), unit * path[:, None])
            blocks.append(np.concatenate((start, -path[:, :, None], cross), axis=2).reshape(-1, _UNKNOWNS))
            variances.append(np.full(path.size, (submap.sigma * unit) ** 2))
        frames = np.concatenate([s.frames for s in submaps])
        columns = (3 * frames[:, None] + np.arange(3)).ravel()
        shape = (len(columns), 3 * len(quats_wxyz))
        here = sparse.csr_array((np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=shape)
        self.rows = sparse.csr_array(sparse.hstack([here, sparse.block_diag(blocks)]))
        self.weights = 1 / np.concatenate(variances)
        self._rotation_weight = np.array([s.span for s in submaps]) / SMOOTHER.submap_orientation_sigma_rad**2

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Prior weights (7 submaps,) of the unknowns, and weights times expected values."""
        # normal in the logarithm of the scale, linearised about the scale so far
        scale, expected = self._scale, self._expected
        lost = ~((scale > expected / SMOOTHER.submap_scale_reset) & (scale < expected * SMOOTHER.submap_scale_reset))
        around = np.where(lost, expected, scale)
        weight = 1 / (self._spread * around) ** 2
        value = around * (1 - np.log(around / expected))
        weights, pulls = np.zeros((2, len(scale), _UNKNOWNS))
        weights[:, :3] = 1e-9  # keeps the system regular
        weights[:, 3], pulls[:, 3] = weight, weight * value
        weights[:, 4:] = self._rotation_weight[:, None]
        return weights.ravel(), pulls.ravel()

    def take(self, unknowns: FloatArray) -> None:
        """Linearise the next time about these unknowns (7 submaps,)."""
        self._scale = unknowns.reshape(-1, _UNKNOWNS)[:, 3]
