"""Fusion of the estimates of one image into a mixture of pose hypotheses: a linear opinion pool (Stone 1961).

The sources are not independent, so probabilities are added, never multiplied: an estimate is weighted by its inlier
probability, the softmax by the probability that all estimates are outliers. Where estimates of two sources agree, the
product of their normal densities replaces the later one, which makes it more precise, not more probable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.settings import CANDIDATES

from .measurement import PoseMeasurement
from .settings import BELIEF

_ROTATIONS = 8 * np.pi**2  # volume of all rotations, in units of small rotation vectors


@dataclass(frozen=True, eq=False)
class Mixture:
    """Pose hypotheses of one image, most probable first."""

    candidates: Candidates
    measured: BoolArray  # (m,) whether a hypothesis is an absolute pose estimate; the others are modes of the softmax


def fuse(modes: Candidates, answers: Sequence[Sequence[PoseMeasurement]], volume_m3: float) -> Mixture:
    """The mixture of one image from the modes of the softmax and the estimates, source by source.

    Of one source's estimates, at most one is right. `volume_m3` is that of all possible positions.
    """
    mixture = Mixture(modes, np.zeros(len(modes.log_mass), dtype=np.bool_))
    anywhere = float(-np.log(volume_m3 * _ROTATIONS))
    for estimates in answers:
        if estimates:
            mixture = _with(mixture, estimates, anywhere)
    return mixture


def inlier_odds(estimates: Sequence[PoseMeasurement]) -> tuple[float, FloatArray]:
    """Log probabilities that none of one source's estimates is right, and that each is."""
    probability = np.clip(
        [e.inlier_probability for e in estimates], BELIEF.least_probability, 1 - BELIEF.least_probability
    )
    odds = probability / (1 - probability)
    total = 1 + odds.sum()
    return float(-np.log(total)), np.asarray(np.log(odds / total))


def _with(mixture: Mixture, estimates: Sequence[PoseMeasurement], anywhere: float) -> Mixture:
    """The mixture once the estimates of one more source are added."""
    none, log_right = inlier_odds(estimates)
    before = mixture.candidates
    parts, marks = [before.normalised(none)], [mixture.measured]
    earlier = before.normalised(float(np.log1p(-BELIEF.alone))).take(np.flatnonzero(mixture.measured))
    for estimate, right in zip(estimates, log_right, strict=True):
        refined, overlap = _product(earlier, estimate)
        agreement = np.append(earlier.log_mass + overlap, np.log(BELIEF.alone) + anywhere)
        shares = right + agreement - logsumexp(agreement)
        parts += [replace(refined, log_mass=shares[:-1]), _single(estimate, shares[-1])]
        marks.append(np.ones(len(shares), dtype=np.bool_))
    return _most_probable(parts, np.concatenate(marks))


def _product(old: Candidates, estimate: PoseMeasurement) -> tuple[Candidates, FloatArray]:
    """Products of normal densities, and the logarithms of their overlap."""
    own, its = old.position_spreads**2, estimate.sigma_m**2
    share = its / (own + its)
    off = (old.positions_xyz - estimate.position_xyz) ** 2 / (own + its)
    overlap = -0.5 * (off + np.log(2 * np.pi * (own + its))).sum(axis=1)
    own_angle, its_angle = old.orientation_spreads_rad**2, estimate.sigma_rad**2
    total = own_angle + its_angle
    centre = Rotation.from_quat(estimate.orientation_quat_wxyz, scalar_first=True)
    apart = (centre.inv() * Rotation.from_quat(old.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
    between = centre * Rotation.from_rotvec((its_angle / total)[:, None] * apart)
    overlap -= 0.5 * ((apart**2).sum(axis=1) / total + 3 * np.log(2 * np.pi * total))
    product = replace(
        old,
        positions_xyz=share * old.positions_xyz + (1 - share) * estimate.position_xyz,
        position_spreads=np.sqrt(own * share),
        orientations_quat_wxyz=between.as_quat(scalar_first=True).reshape(-1, 4),
        orientation_spreads_rad=np.sqrt(own_angle * its_angle / total),
    )
    return product, overlap


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
