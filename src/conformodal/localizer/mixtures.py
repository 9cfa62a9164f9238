"""Mixtures of poses: what is believed of a camera's pose, by its image alone or by all frames so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray

MAX_HYPOTHESES = 48  # of a mixture that is fused or filtered
MIN_VARIANCE = 1e-12  # m^2 and rad^2: a covariance can be inverted
_ROUNDING = 1e-6  # of the logarithm of a sum of probabilities


@dataclass(frozen=True, eq=False)
class PoseMixture:
    """A mixture of m normal densities of a camera's pose, its hypotheses: at least one, and their weights sum to one.

    Raises
    ------
    ValueError
        If the weights do not sum to one.
    """

    positions_xyz: FloatArray  # (m, 3) metres, world: means and standard deviations
    position_spreads: FloatArray
    orientations_quat_wxyz: FloatArray  # (m, 4) unit quaternions, world from camera
    orientation_spreads_rad: FloatArray  # (m,) standard deviation of each component of a small rotation
    log_weights: FloatArray  # (m,) logarithms of probabilities
    # (m,) whether a density stands for itself. That of a mode of the softmax does not: its extent is told by the bins
    measured: BoolArray

    def __post_init__(self) -> None:
        total = np.logaddexp.reduce(self.log_weights)
        if not abs(total) < _ROUNDING:
            raise ValueError(f"the weights of a mixture of poses must sum to 1, got {np.exp(total):.9g}")

    @classmethod
    def weighted(
        cls,
        positions_xyz: FloatArray,
        position_spreads: FloatArray,
        orientations_quat_wxyz: FloatArray,
        orientation_spreads_rad: FloatArray,
        log_weights: FloatArray,
        *,
        measured: bool = True,
    ) -> Self:
        """From weights (m,) of which only the ratios count."""
        total, marks = np.logaddexp.reduce(log_weights), np.full(len(log_weights), measured)
        poses = positions_xyz, position_spreads, orientations_quat_wxyz, orientation_spreads_rad
        return cls(*poses, log_weights - total, marks)

    def __len__(self) -> int:
        return len(self.log_weights)

    @property
    def weights(self) -> FloatArray:
        """(m,) probabilities of the hypotheses."""
        return np.exp(self.log_weights)

    def part(self, rows: IntArray | BoolArray) -> Self:
        """The mixture if one of these hypotheses is right, in the order of `rows`; not all of them are impossible."""
        chosen = {name: getattr(self, name)[rows] for name in self.__match_args__}
        total = np.logaddexp.reduce(chosen["log_weights"])
        return type(self)(**chosen | {"log_weights": chosen["log_weights"] - total})

    def reweighted(self, log_weights: FloatArray) -> Self:
        """The same hypotheses with other weights (m,), of which only the ratios count."""
        return replace(self, log_weights=log_weights - np.logaddexp.reduce(log_weights))

    def covariance(self, position_xyz: FloatArray, quat_wxyz: FloatArray) -> FloatArray:
        """Second moments (6, 6) around a pose, in m^2, m rad and rad^2.

        The first three are x, y and z of the world. The others are small rotations about x, y and z of the world,
        which do not turn with the camera: the true orientation is ``exp(r) R_world_cam``.
        """
        chosen = Rotation.from_quat(quat_wxyz, scalar_first=True)
        turned = (Rotation.from_quat(self.orientations_quat_wxyz, scalar_first=True) * chosen.inv()).as_rotvec()
        off = np.concatenate((self.positions_xyz - position_xyz, turned), axis=1)
        turning = np.repeat(self.orientation_spreads_rad[:, None], 3, axis=1)
        spreads = np.concatenate((self.position_spreads, turning), axis=1)
        moments = (self.weights[:, None] * off).T @ off + np.diag(self.weights @ spreads**2 + MIN_VARIANCE)
        return np.asarray((moments + moments.T) / 2)


class Share(NamedTuple):
    """A part of a pool of mixtures."""

    mixture: PoseMixture
    log_weight: float  # only the ratios of those of all parts count


def pool(parts: Sequence[Share]) -> PoseMixture:
    """The linear opinion pool (Stone 1961) of mixtures: their hypotheses one after the other."""
    names = PoseMixture.__match_args__
    columns = {name: np.concatenate([getattr(part.mixture, name) for part in parts]) for name in names}
    shares = np.concatenate([part.mixture.log_weights + part.log_weight for part in parts])
    return PoseMixture(**columns | {"log_weights": shares - np.logaddexp.reduce(shares)})
