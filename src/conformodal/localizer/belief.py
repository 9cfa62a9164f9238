"""Beliefs: the probability distribution of an image's pose, a mixture of the softmax and absolute pose estimates.

Regions are calibrated from its marginals over fine cells; its hypotheses are the candidates of the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

from .filter import Posterior
from .fusion import Mixture
from .measurement import PoseMeasurement
from .settings import BELIEF, FILTER

Kind = TypeVar("Kind", bound=np.generic)

_LEAST_ANGLE = 1e-4


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Beliefs about the poses of n images."""

    proba: list[RealArray]  # seven arrays (n, K_j): the softmax over the bins
    mixtures: Sequence[Mixture]  # pose hypotheses, image by image
    estimates: Sequence[Sequence[PoseMeasurement]]  # from local features, image by image

    def __len__(self) -> int:
        return len(self.mixtures)

    @property
    def recognised(self) -> BoolArray:
        """(n,) whether a place was recognised by local features."""
        return np.array([bool(recognised_only(estimates)) for estimates in self.estimates], dtype=np.bool_)

    @property
    def recognition(self) -> FloatArray:
        """(n,) how strongly a place was recognised: inliers times the share of the image they cover; 0 if none was."""
        strengths = (
            [one.n_inliers * one.image_share for one in recognised_only(estimates)] for estimates in self.estimates
        )
        return np.array([max(estimates, default=0.0) for estimates in strengths])

    def part(self, rows: slice | IntArray) -> Beliefs:
        """The beliefs about some of the images."""
        numbers = np.arange(len(self))[rows].tolist()
        mixtures, estimates = [self.mixtures[i] for i in numbers], [self.estimates[i] for i in numbers]
        return Beliefs([p[rows] for p in self.proba], mixtures, estimates)

    def after(self, posteriors: Sequence[Posterior]) -> Beliefs:
        """The beliefs once other frames are known: each posterior, and where it is wrong, the image's own belief.

        The latter keeps a share whatever the posterior claims, which may be sure and wrong through a whole stretch.
        """
        mixtures = []
        for mixture, posterior in zip(self.mixtures, posteriors, strict=True):
            from_posterior = np.ones(len(posterior.hypotheses.log_mass), dtype=np.bool_)
            joined = posterior.with_image(mixture.candidates, FILTER.least_own)
            mixtures.append(Mixture(joined, np.concatenate((from_posterior, mixture.measured))))
        return Beliefs(self.proba, mixtures, self.estimates)

    def marginals(self, bins: QuantileBins, cells: QuantileBins, sign_reference: FloatArray) -> list[FloatArray]:
        """Seven arrays (n, cells) of probabilities whose rows sum to one, over the :func:`belief_cells` of the bins."""
        blocks = [on_cells(p.astype(np.float64) / cells_per_bin(bins), bins) for p in self.proba]
        for i, mixture in enumerate(self.mixtures):
            mass = np.exp(mixture.candidates.log_mass)
            mass /= mass.sum()
            counted = mixture.measured & (mass > BELIEF.negligible)
            if not counted.any():
                continue
            weights = mass[counted]
            places, sigmas = _as_targets(mixture, counted, sign_reference)
            for j, edges in enumerate(cells.edges_):
                away = (edges - places[:, j, None]) / sigmas[:, j, None]
                inside = np.maximum(np.diff(_student_cdf(away), axis=1), 0)  # far away, rounding makes some negative
                blocks[j][i] = blocks[j][i] * (1 - weights.sum()) + weights @ inside
        return [pool / pool.sum(axis=1, keepdims=True) for pool in blocks]


def recognised_only(estimates: Sequence[PoseMeasurement]) -> list[PoseMeasurement]:
    """The estimates of an image that are probably inliers."""
    return [one for one in estimates if one.inlier_probability >= BELIEF.recognised]


def belief_cells(bins: QuantileBins) -> QuantileBins:
    """Cells that divide the bins, and wider and wider cells beyond them; edges of bins are edges of cells."""
    growth = np.cumsum(BELIEF.wider ** np.arange(1, BELIEF.beyond + 1))
    edges = []
    for fine in bins.refine(cells_per_bin(bins)).edges_:
        steps = (fine[-1] - fine[0]) / (fine.size - 1) * growth
        edges.append(np.concatenate((fine[0] - steps[::-1], fine, fine[-1] + steps)))
    return QuantileBins.from_edges(edges)


def on_cells(values: npt.NDArray[Kind], bins: QuantileBins) -> npt.NDArray[Kind]:
    """Values of bins (n, K) repeated for every cell in them, (n, cells); 0 beyond the bins."""
    return np.pad(np.repeat(values, cells_per_bin(bins), axis=1), ((0, 0), (BELIEF.beyond, BELIEF.beyond)))


def cells_per_bin(bins: QuantileBins) -> int:
    """Number of cells per bin."""
    return max(1, -(-BELIEF.cells // max(bins.sizes)))


def _student_cdf(x: FloatArray) -> FloatArray:
    """Student's t with three degrees of freedom: large errors are more common than under a normal distribution."""
    scaled = x / np.sqrt(3)
    return np.asarray(0.5 + (scaled / (1 + scaled**2) + np.arctan(scaled)) / np.pi)


def _as_targets(mixture: Mixture, rows: BoolArray, sign_reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hypotheses as targets and their standard deviations, (m, 7) each."""
    hypotheses = mixture.candidates
    quats = hypotheses.orientations_quat_wxyz[rows]
    quats = np.where((quats @ sign_reference < 0)[:, None], -quats, quats)
    # a rotation by a small angle moves a unit quaternion by half of it, orthogonally to itself
    angle = hypotheses.orientation_spreads_rad[rows, None] / 2 * np.sqrt(np.maximum(1 - quats**2, _LEAST_ANGLE))
    return (
        np.concatenate((hypotheses.positions_xyz[rows], quats), axis=1),
        np.concatenate((hypotheses.position_spreads[rows], angle), axis=1),
    )
