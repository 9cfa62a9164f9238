"""From probabilities to candidate poses, position and orientation together, and their fusion with pose estimates.

:func:`mode_candidates`, the default, cuts a target's range into basins, one a peak of the softmax, at the valleys
between; a basin stands for its mean. :func:`interval_candidates` takes cuboids of the region as the paper does, each
at the mean of its intervals. Cut off at the region's ends the mean is worse (twice, on hand-held video), and a path of
hundreds of frames cannot be confined to regions that are right nine times in ten.

Means are taken in bin coordinates: bins have unequal widths, labels are spread evenly over bin numbers, so only
there is the mean unbiased. The product over targets is built target by target, keeping the most probable; it is
never formed whole.

Fusion is a linear opinion pool (Stone 1961). The sources are not independent, so probabilities are added, never
multiplied: an estimate is weighted by its inlier probability, the softmax by the probability that all estimates are
outliers. Where estimates of two sources agree, the product of their normal densities replaces the later one, which
makes it more precise, not more probable. Others stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.conformal import QuantileBins, Regions
from conformodal.core.arrays import BoolArray, FloatArray, RealArray, Rows
from conformodal.geometry import Trajectory, fix_sign, normalise_quat

from .evidence import PoseMeasurement

TARGET_NAMES = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")  # of a pose: position, and quaternion
MIN_VARIANCE = 1e-12  # m^2 and rad^2: a covariance can be inverted
MOST = 48  # candidates of a frame
# probability below which a candidate is dropped, unless it is the most probable one. Chosen on seeds 20 and 21:
# at 1e-4, frames without the true room make the corridor's path 4 times worse
_MIN_MASS = 1e-6
# two peaks of a softmax are two modes where the probability between them falls below this share of the lower one
_VALLEY_SHARE = 0.5
# standard deviation of the norm of a quaternion whose components were chosen one by one: the further from one, the
# less they fit together
_NORM_SIGMA = 0.1
_MIN_PROBABILITY = 0.01  # of an inlier and of an outlier
# Squared Mahalanobis distance (six degrees of freedom) up to which two estimates agree; of those that are right and
# independent, 24 % are further apart. Chosen on seeds 20 and 21: beyond, sources that err by more pull at better ones
AGREE = 8.0

Probabilities: TypeAlias = Sequence[RealArray]


def pose_targets(poses: Trajectory, sign_reference: FloatArray) -> FloatArray:
    """Targets (n, 7): metres, then the quaternion with the sign that `sign_reference` (4,) gives it."""
    return np.column_stack((poses.positions_xyz, fix_sign(poses.orientations_quat_wxyz, sign_reference)))


@dataclass(frozen=True, eq=False)
class Candidates(Rows):
    """Pose hypotheses of one frame, most probable first: of its image, or of a posterior."""

    positions_xyz: FloatArray  # (m, 3) metres: means and standard deviations
    position_spreads: FloatArray
    orientations_quat_wxyz: FloatArray  # (m, 4) unit quaternions, and standard deviations (m,)
    orientation_spreads_rad: FloatArray
    log_mass: FloatArray  # (m,) log probability of the pose

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
    moments = (weights[:, None] * off).T @ off + np.diag(weights @ spreads**2 + MIN_VARIANCE)
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
        candidates.append(_combine(targets, np.log(_MIN_MASS)))
    return candidates


def interval_candidates(proba: Probabilities, regions: Regions) -> list[Candidates]:
    """Candidates of every frame: the most probable cuboids of its region, each at the means of its intervals.

    Where a target's set is empty, its most probable bin stands in. The paper's reasoning chooses
    among all cuboids.
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


@dataclass(frozen=True, eq=False)
class BinRuns:
    """Runs of neighbouring bins of one target, or combinations of such runs of d targets."""

    mean: FloatArray  # (m,) or (m, d) means and standard deviations within the run, in the target's unit
    spread: FloatArray
    log_mass: FloatArray  # (m,) logarithm of the probability


def _described(p: FloatArray, runs: list[tuple[int, int]], edges: FloatArray) -> BinRuns:
    """Means, spreads and masses of runs of bins ``first, ..., last - 1`` with probabilities `p`."""
    ends, bins, grid = np.array(runs), np.append(np.arange(len(p)) + 0.5, 0.0), np.arange(edges.size)
    weights = np.append(p + 1e-12, 0.0)  # so that a run may end with the last bin
    # the width of the peak, not of its tails: squared weights of a Gaussian are a Gaussian, narrower by sqrt(2)
    sharp = weights**2
    moments = np.stack((weights, weights * bins, sharp, sharp * bins, sharp * bins**2))
    mass, first, sharp_mass, sharp_first, sharp_second = np.add.reduceat(moments, ends.ravel(), axis=1)[:, ::2]
    mean, centre = first / mass, sharp_first / sharp_mass
    spread = np.sqrt(2 * np.maximum(sharp_second / sharp_mass - centre**2, 0) + 1 / 12)
    low, at, high = np.interp((mean - spread, mean, mean + spread), grid, edges)
    return BinRuns(at, np.maximum((high - low) / 2, 1e-9), np.log(mass))


def _basins(p: FloatArray) -> list[tuple[int, int]]:
    """Cut all bins at the lowest between peaks that stand clear of it."""
    cuts = [0]
    peak_at = valley_at = 0
    for k in range(1, len(p)):
        if p[k] < p[valley_at]:
            valley_at = k
            continue
        if p[valley_at] < _VALLEY_SHARE * min(p[peak_at], p[k]):
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
        best = np.argsort(-total, kind="stable")[:MOST]
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
        turn_mass = (quats.log_mass - 0.5 * ((norm - 1) / _NORM_SIGMA) ** 2)[sound]
    else:  # components that cancel say nothing
        unit, turn, turn_mass = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([np.pi]), np.zeros(1)
    places = _product(targets[:3])
    mass = places.log_mass[:, None] + turn_mass
    best = np.argsort(-mass, axis=None, kind="stable")[:MOST]
    best = best[mass.flat[best] >= min(least_log_mass, mass.flat[best[0]])]
    at, facing = np.unravel_index(best, mass.shape)
    return Candidates(places.mean[at], places.spread[at], unit[facing], turn[facing], mass[at, facing])


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
    stated = [estimate.inlier_probability for estimate in estimates]
    probability = np.clip(stated, _MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
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
    return product.take(np.flatnonzero(square <= AGREE))


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
    order = np.argsort(-log_mass, kind="stable")[:MOST]
    order = order[log_mass[order] >= min(np.log(_MIN_MASS), log_mass[order[0]])]
    return Mixture(joined.take(order), measured[order])
