"""Fusion of the modes of the softmax with pose estimates, to the mixture of one image.

The fusion is a linear opinion pool (Stone 1961). The sources are not independent, so probabilities are added, never
multiplied: an estimate is weighted by its inlier probability, the softmax by the probability that all estimates are
outliers. Where estimates of two sources agree, the product of their normal densities replaces the later one, which
makes it more precise, not more probable. Others stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray

from .evidence import PoseMeasurement
from .mixtures import MAX_HYPOTHESES, PoseMixture, Share, pool
from .modes import MIN_MASS

_MIN_PROBABILITY = 0.01  # of an inlier and of an outlier
# Squared Mahalanobis distance (six degrees of freedom) up to which two estimates agree; of those that are right and
# independent, 24 % are further apart. Chosen on seeds 20 and 21: beyond, sources that err by more pull at better ones
AGREE = 8.0


def fuse(modes: PoseMixture, answers: Sequence[Sequence[PoseMeasurement]]) -> PoseMixture:
    """The mixture of one image from the modes of the softmax and the estimates, source by source, most probable first.

    Of one source's estimates, at most one is right.
    """
    mixture = modes
    for estimates in answers:
        if estimates:
            mixture = _with(mixture, estimates)
    return mixture


def inlier_odds(estimates: Sequence[PoseMeasurement]) -> tuple[float, FloatArray]:
    """Log probabilities that none of one source's estimates is right, and that each is."""
    stated = [estimate.inlier_probability for estimate in estimates]
    probability = np.clip(stated, _MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    odds = probability / (1 - probability)
    total = 1 + odds.sum()
    return float(-np.log(total)), np.asarray(np.log(odds / total))


def _with(mixture: PoseMixture, estimates: Sequence[PoseMeasurement]) -> PoseMixture:
    """The mixture once the estimates of one more source are added, without improbable hypotheses."""
    none, log_right = inlier_odds(estimates)
    earlier = mixture.part(mixture.measured) if mixture.measured.any() else None
    parts = [Share(mixture, none)]
    for estimate, right in zip(estimates, log_right.tolist(), strict=True):
        refined = None if earlier is None else _refined(estimate, earlier)
        parts.append(Share(_single(estimate) if refined is None else refined, right))
    joined = pool(parts)
    order = np.argsort(-joined.log_weights, kind="stable")[:MAX_HYPOTHESES]
    least = min(np.log(MIN_MASS), joined.log_weights[order[0]])
    return joined.part(order[joined.log_weights[order] >= least])


def _refined(estimate: PoseMeasurement, earlier: PoseMixture) -> PoseMixture | None:
    """Products of an estimate's normal density with those that it agrees with, by how much they overlap.

    None if it agrees with none.
    """
    centre = Rotation.from_quat(estimate.orientation_quat_wxyz, scalar_first=True)
    apart = (centre.inv() * Rotation.from_quat(earlier.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
    earlier_variance, variance = earlier.position_spreads**2, estimate.sigma_m**2
    earlier_angle, angle = earlier.orientation_spreads_rad**2, estimate.sigma_rad**2
    total_variance, total_angle = earlier_variance + variance, earlier_angle + angle
    square = ((earlier.positions_xyz - estimate.position_xyz) ** 2 / total_variance).sum(axis=1)
    square += (apart**2).sum(axis=1) / total_angle
    agree = np.flatnonzero(square <= AGREE)
    if not agree.size:
        return None
    share, between = variance / total_variance, Rotation.from_rotvec((angle / total_angle)[:, None] * apart)
    product = PoseMixture.weighted(
        share * earlier.positions_xyz + (1 - share) * estimate.position_xyz,
        np.sqrt(earlier_variance * share),
        (centre * between).as_quat(scalar_first=True).reshape(-1, 4),
        np.sqrt(earlier_angle * angle / total_angle),
        earlier.log_weights - 0.5 * (square + np.log(total_variance).sum(axis=1) + 3 * np.log(total_angle)),
    )
    return product.part(agree)


def _single(estimate: PoseMeasurement) -> PoseMixture:
    return PoseMixture.weighted(
        estimate.position_xyz[None],
        np.full((1, 3), estimate.sigma_m),
        estimate.orientation_quat_wxyz[None],
        np.array([estimate.sigma_rad]),
        np.zeros(1),
    )
