"""Fusion of the estimates of one image into a mixture of pose hypotheses: a linear opinion pool (Stone 1961).

The sources are not independent, so probabilities are added, never multiplied: an estimate is weighted by its inlier
probability, the softmax by the probability that all estimates are outliers. Where estimates of two sources agree, the
product of their normal densities replaces the later one, which makes it more precise, not more probable. Others stay as
they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray

from .candidates import Candidates
from .measurement import PoseMeasurement
from .settings import BELIEF, CANDIDATES


@dataclass(frozen=True, eq=False)
class Mixture:
    """Pose hypotheses of one image, most probable first."""

    candidates: Candidates
    measured: BoolArray  # (m,) whether a hypothesis is an absolute pose estimate; the others are modes of the softmax


def fuse(modes: Candidates, answers: Sequence[Sequence[PoseMeasurement]]) -> Mixture:
    """The mixture of one image from the modes of the softmax and the estimates, source by source.

    Of one source's estimates, at most one is right.
    """
    mixture = Mixture(modes, np.zeros(len(modes.log_mass), dtype=np.bool_))
    for estimates in answers:
        if estimates:
            mixture = _with(mixture, estimates)
    return mixture


def inlier_odds(estimates: Sequence[PoseMeasurement]) -> tuple[float, FloatArray]:
    """Log probabilities that none of one source's estimates is right, and that each is."""
    probability = np.clip(
        [e.inlier_probability for e in estimates], BELIEF.least_probability, 1 - BELIEF.least_probability
    )
    odds = probability / (1 - probability)
    total = 1 + odds.sum()
    return float(-np.log(total)), np.asarray(np.log(odds / total))


def _with(mixture: Mixture, estimates: Sequence[PoseMeasurement]) -> Mixture:
    """The mixture once the estimates of one more source are added."""
    none, log_right = inlier_odds(estimates)
    earlier, parts = mixture.candidates.take(np.flatnonzero(mixture.measured)), [mixture.candidates.normalised(none)]
    for estimate, right in zip(estimates, log_right, strict=True):
        refined = _refined(estimate, earlier)
        parts.append(refined.normalised(right) if len(refined.log_mass) else _single(estimate, right))
    marks = np.ones(sum(len(part.log_mass) for part in parts), dtype=np.bool_)
    marks[: len(mixture.measured)] = mixture.measured
    return _most_probable(parts, marks)


def _refined(estimate: PoseMeasurement, old: Candidates) -> Candidates:
    """Products of an estimate's normal density with those that it agrees with, by how much they overlap."""
    centre = Rotation.from_quat(estimate.orientation_quat_wxyz, scalar_first=True)
    apart = (centre.inv() * Rotation.from_quat(old.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
    old_variance, variance = old.position_spreads**2, estimate.sigma_m**2
    old_angle, angle = old.orientation_spreads_rad**2, estimate.sigma_rad**2
    total = old_angle + angle
    square = ((old.positions_xyz - estimate.position_xyz) ** 2 / (old_variance + variance)).sum(axis=1)
    square += (apart**2).sum(axis=1) / total
    share, between = variance / (old_variance + variance), Rotation.from_rotvec((angle / total)[:, None] * apart)
    product = Candidates(
        share * old.positions_xyz + (1 - share) * estimate.position_xyz,
        np.sqrt(old_variance * share),
        (centre * between).as_quat(scalar_first=True).reshape(-1, 4),
        np.sqrt(old_angle * angle / total),
        old.log_mass - 0.5 * (square + np.log(old_variance + variance).sum(axis=1) + 3 * np.log(total)),
    )
    return product.take(np.flatnonzero(square <= BELIEF.agree))


def _single(estimate: PoseMeasurement, log_mass: float) -> Candidates:
    return Candidates(
        estimate.position_xyz[None],
        np.full((1, 3), estimate.sigma_m),
        estimate.orientation_quat_wxyz[None],
        np.array([estimate.sigma_rad]),
        np.array([log_mass]),
    )


def _most_probable(parts: Sequence[Candidates], measured: BoolArray) -> Mixture:
    """All hypotheses, most probable first, without the improbable ones."""
    joined = Candidates.concatenate(parts).normalised()
    log_mass = joined.log_mass
    order = np.argsort(-log_mass, kind="stable")[: CANDIDATES.most]
    order = order[log_mass[order] >= min(np.log(CANDIDATES.least_mass), log_mass[order[0]])]
    return Mixture(joined.take(order), measured[order])
