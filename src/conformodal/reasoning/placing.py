"""Where submaps lie in the world: terms of the least squares problem that smooths positions.

A submap knows its part of the path but for where it starts, how long it is, and what the anchor's orientation is off
by: seven unknowns. With orientations known, all are linear.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import sparse

from conformodal.poses import Submap, matrix_from_quat_wxyz

from .prior import MotionPrior

FloatArray = npt.NDArray[np.float64]

UNKNOWNS = 7  # start (3), length, turn (3)
# How far a smoothed orientation may be off where all of a stretch is.
_TURN_RAD = np.radians(10.0)
# Beyond this factor from what depths make one expect, a length starts again from there.
_FARTHEST = 5.0


class Placing:
    """Submaps among n frames.

    Parameters
    ----------
    submaps
        Frames numbered 0 to n - 1.
    quats_wxyz
        (n, 4) orientations of the frames.
    prior
        Gives the depths to expect, and so the lengths.

    Attributes
    ----------
    rows
        Sparse (m, 3 n + 7 submaps): position minus where the submap has it, metres; zero where they agree.
    weights
        (m,) one over the variances.
    """

    def __init__(self, submaps: Sequence[Submap], quats_wxyz: FloatArray, prior: MotionPrior) -> None:
        self._expected = prior.depth_m / np.array([s.depth for s in submaps])
        # a network's errors last: all frames of a stretch together say of its length little more than one of them
        spread = prior.depth_spread / np.sqrt([s.span for s in submaps])
        self._spread, self._length = spread, self._expected.copy()
        blocks, variances = [], []
        for submap, unit in zip(submaps, self._expected, strict=True):
            path = submap.positions @ matrix_from_quat_wxyz(quats_wxyz[submap.frames[:1]])[0].T
            start = np.broadcast_to(-np.eye(3), (len(path), 3, 3))
            # to turn by w about the anchor moves a place v away from it by w x v = -[v]x w
            cross = np.cross(np.eye(3), unit * path[:, None])
            blocks.append(np.concatenate((start, -path[:, :, None], cross), axis=2).reshape(-1, UNKNOWNS))
            variances.append(np.full(path.size, (submap.sigma * unit) ** 2))
        frames = np.concatenate([s.frames for s in submaps])
        columns = (3 * frames[:, None] + np.arange(3)).ravel()
        shape = (len(columns), 3 * len(quats_wxyz))
        here = sparse.csr_array((np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=shape)
        self.rows = sparse.csr_array(sparse.hstack([here, sparse.block_diag(blocks)]))
        self.weights = 1 / np.concatenate(variances)
        self._turn_weight = np.array([s.span for s in submaps]) / _TURN_RAD**2

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Weights (7 submaps,) of what is known of the unknowns beforehand, and weights times values."""
        # normal in the logarithm of the length, linearised about the length so far
        length, expected = self._length, self._expected
        lost = ~((length > expected / _FARTHEST) & (length < expected * _FARTHEST))
        around = np.where(lost, expected, length)
        weight = 1 / (self._spread * around) ** 2
        value = around * (1 - np.log(around / expected))
        weights, pulls = np.zeros((2, len(length), UNKNOWNS))
        weights[:, :3] = 1e-9  # keeps the system regular
        weights[:, 3], pulls[:, 3] = weight, weight * value
        weights[:, 4:] = self._turn_weight[:, None]
        return weights.ravel(), pulls.ravel()

    def take(self, unknowns: FloatArray) -> None:
        """Linearise the next time about these unknowns (7 submaps,)."""
        self._length = unknowns.reshape(-1, UNKNOWNS)[:, 3]
