"""From probabilities to candidate poses, position and orientation together.

:func:`mode_candidates`, the default, cuts a target's range into basins, one a peak of the softmax, at the valleys
between; a basin stands for its mean. :func:`interval_candidates` takes cuboids of the region as the paper does, each
at the mean of its intervals. Cut off at the region's ends the mean is worse (twice, on hand-held video), and a path of
hundreds of frames cannot be confined to regions that are right nine times in ten.

Means are taken in bin coordinates: bins have unequal widths, labels are spread evenly over bin numbers, so only
there is the mean unbiased. The product over targets is built target by target, keeping the most probable; it is
never formed whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.conformal import QuantileBins, Regions
from conformodal.core.arrays import FloatArray, RealArray, Rows
from conformodal.geometry import normalise_quat

from .settings import CANDIDATES

LEAST_VARIANCE = 1e-12  # m^2 and rad^2: a covariance can be inverted
Probabilities: TypeAlias = Sequence[RealArray]


@dataclass(frozen=True, eq=False)
class Candidates(Rows):
    """Pose hypotheses of one frame, most probable first: of its image, or of a posterior.

    Attributes
    ----------
    positions_xyz, position_spreads
        (m, 3) metres: means and standard deviations.
    orientations_quat_wxyz, orientation_spreads_rad
        (m, 4) unit quaternions, and (m,).
    log_mass
        (m,) log probability of the pose.
    """

    positions_xyz: FloatArray
    position_spreads: FloatArray
    orientations_quat_wxyz: FloatArray
    orientation_spreads_rad: FloatArray
    log_mass: FloatArray

    def normalised(self, log_share: float = 0.0) -> Self:
        """The same candidates with probabilities that sum to ``exp(log_share)``."""
        return replace(self, log_mass=self.log_mass - np.logaddexp.reduce(self.log_mass) + log_share)


def mixture_covariance(candidates: Candidates, position_xyz: FloatArray, quat_wxyz: FloatArray) -> FloatArray:
    """Second moments (6, 6) of a mixture of normal densities around a pose, in m^2, m rad and rad^2.

    The first three are x, y and z of the world. The others are small rotations about x, y and z of the world, which do
    not turn with the camera: the true orientation is ``exp(r) R_world_cam``.
    """
    weights = weights_of(candidates)
    chosen = Rotation.from_quat(quat_wxyz, scalar_first=True)
    turned = (Rotation.from_quat(candidates.orientations_quat_wxyz, scalar_first=True) * chosen.inv()).as_rotvec()
    off = np.concatenate((candidates.positions_xyz - position_xyz, turned), axis=1)
    turning = np.repeat(candidates.orientation_spreads_rad[:, None], 3, axis=1)
    spreads = np.concatenate((candidates.position_spreads, turning), axis=1)
    moments = (weights[:, None] * off).T @ off + np.diag(weights @ spreads**2 + LEAST_VARIANCE)
    return np.asarray((moments + moments.T) / 2)


def weights_of(candidates: Candidates) -> FloatArray:
    """Probabilities (m,) that sum to one."""
    share = np.exp(candidates.log_mass - candidates.log_mass.max())
    return np.asarray(share / share.sum())


def mode_candidates(proba: Probabilities, bins: QuantileBins) -> list[Candidates]:
    """Candidates of every frame: the modes of the softmax, seven arrays (n, K_j) over the bins of the targets."""
    candidates = []
    for i in range(len(proba[0])):
        rows = [p[i].astype(np.float64) for p in proba]
        targets = [_described(p, _basins(p), e) for p, e in zip(rows, bins.edges_, strict=True)]
        candidates.append(_combine(targets, np.log(CANDIDATES.least_mass)))
    return candidates


def interval_candidates(proba: Probabilities, regions: Regions) -> list[Candidates]:
    """Candidates of every frame: the most probable cuboids of its region, each at the means of its intervals.

    Where a target's set is empty, its most probable bin stands in. :func:`~conformodal.localizer.greedy` chooses among
    all cuboids, as the paper does.
    """
    return [_combine(targets, -np.inf) for targets in interval_runs(proba, regions)]


def interval_runs(proba: Probabilities, regions: Regions) -> list[list[BinRuns]]:
    """The intervals of every frame's region, target by target; the most probable bin where a set is empty."""
    # a score that cuts bins into cells gives regions over cells: each holds its share of the bin's probability
    cells = [k // p.shape[1] for k, p in zip(regions.bins.sizes, proba, strict=True)]
    proba = [np.repeat(p / c, c, axis=1) if c > 1 else p for c, p in zip(cells, proba, strict=True)]
    frames = []
    for i in range(len(regions)):
        targets = []
        for p, e, runs in zip(proba, regions.bins.edges_, regions.runs(i), strict=True):
            best = int(np.argmax(p[i]))
            intervals = [(int(a), int(b)) for a, b in runs] or [(best, best + 1)]
            targets.append(_described(p[i].astype(np.float64), intervals, e))
        frames.append(targets)
    return frames


def softmax_mean(proba: Probabilities, bins: QuantileBins) -> FloatArray:
    """Mean of every target under its softmax, in bin coordinates, (n, d): the estimate without regions or motion."""
    return np.stack([_mean(p.astype(np.float64), e)[0] for p, e in zip(proba, bins.edges_, strict=True)], axis=1)


@dataclass(frozen=True, eq=False)
class BinRuns:
    """Runs of neighbouring bins of one target, or combinations of such runs of d targets."""

    mean: FloatArray  # (m,) or (m, d) means and standard deviations within the run, in the target's unit
    spread: FloatArray
    log_mass: FloatArray  # (m,) logarithm of the probability


def _mean(weights: FloatArray, edges: FloatArray, first: int = 0) -> tuple[FloatArray, FloatArray]:
    """Mean and spread of weights over bins ``first, first + 1, ...`` (last axis), in the target's unit."""
    at = np.arange(first, first + weights.shape[-1]) + 0.5
    total = weights.sum(axis=-1)
    mean = (weights * at).sum(axis=-1) / total
    # the width of the peak, not of its tails: squared weights of a Gaussian are a Gaussian, narrower by sqrt(2)
    sharp = weights**2
    centre = (sharp * at).sum(axis=-1) / sharp.sum(axis=-1)
    spread = np.sqrt(2 * (sharp * (at - centre[..., None]) ** 2).sum(axis=-1) / sharp.sum(axis=-1) + 1 / 12)
    grid = np.arange(edges.size)
    low, high = np.interp(mean - spread, grid, edges), np.interp(mean + spread, grid, edges)
    return np.interp(mean, grid, edges), np.maximum((high - low) / 2, 1e-9)


def _described(p: FloatArray, runs: list[tuple[int, int]], edges: FloatArray) -> BinRuns:
    """Means, spreads and masses of runs of bins ``first, ..., last - 1`` with probabilities `p`."""
    means, spreads, masses = [], [], []
    for a, b in runs:
        weights = p[a:b] + 1e-12
        mean, spread = _mean(weights, edges, a)
        means.append(float(mean))
        spreads.append(float(spread))
        masses.append(float(weights.sum()))
    return BinRuns(np.array(means), np.array(spreads), np.log(masses))


def _basins(p: FloatArray) -> list[tuple[int, int]]:
    """Cut all bins at the lowest between peaks that stand clear of it."""
    cuts = [0]
    peak_at = valley_at = 0
    for k in range(1, len(p)):
        if p[k] < p[valley_at]:
            valley_at = k
            continue
        if p[valley_at] < CANDIDATES.valley_share * min(p[peak_at], p[k]):
            cuts.append(valley_at)
            peak_at = valley_at = k
        elif p[k] > p[peak_at]:
            peak_at = valley_at = k
    return list(zip(cuts, [*cuts[1:], len(p)], strict=True))


def _product(targets: list[BinRuns]) -> BinRuns:
    """The most probable combinations of one run a target, most probable first."""
    mean, spread, log_mass = np.empty((1, 0)), np.empty((1, 0)), np.zeros(1)
    for runs in targets:
        total = (log_mass[:, None] + runs.log_mass[None, :]).ravel()
        best = np.argsort(-total, kind="stable")[: CANDIDATES.most]
        left, right = np.divmod(best, len(runs.log_mass))
        mean = np.column_stack((mean[left], runs.mean[right]))
        spread = np.column_stack((spread[left], runs.spread[right]))
        log_mass = total[best]
    return BinRuns(mean, spread, log_mass)


def _combine(targets: list[BinRuns], least_log_mass: float) -> Candidates:
    """The most probable combinations of one run a target; those below a log mass are dropped, but for the first."""
    quats = _product(targets[3:])
    norm = np.linalg.norm(quats.mean, axis=1)
    sound = norm > 1e-6
    if sound.any():
        unit = normalise_quat(quats.mean[sound])
        # a quaternion moves half as far as the rotation turns
        turn = 2 * np.sqrt(np.mean(quats.spread[sound] ** 2, axis=1))
        turn_mass = (quats.log_mass - 0.5 * ((norm - 1) / CANDIDATES.norm_sigma) ** 2)[sound]
    else:  # components that cancel say nothing
        unit, turn, turn_mass = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([np.pi]), np.zeros(1)
    places = _product(targets[:3])
    mass = places.log_mass[:, None] + turn_mass
    best = np.argsort(-mass, axis=None, kind="stable")[: CANDIDATES.most]
    best = best[mass.flat[best] >= min(least_log_mass, mass.flat[best[0]])]
    at, facing = np.unravel_index(best, mass.shape)
    return Candidates(places.mean[at], places.spread[at], unit[facing], turn[facing], mass[at, facing])
