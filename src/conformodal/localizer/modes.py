"""From bin probabilities to mixtures of poses, position and orientation together.

:func:`mode_mixtures`, the default, cuts a target's range into basins, one a peak of the softmax, at the valleys
between; a basin stands for its mean. :func:`interval_mixtures` takes cuboids of the region as the paper does, each
at the mean of its intervals. Cut off at the region's ends the mean is worse (twice, on hand-held video), and a path of
hundreds of frames cannot be confined to regions that are right nine times in ten.

Means are taken in bin coordinates: bins have unequal widths, labels are spread evenly over bin numbers, so only
there is the mean unbiased. The product over targets is built target by target, keeping the most probable; it is
never formed whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from conformodal.conformal import QuantileBins, Regions
from conformodal.core.arrays import FloatArray, RealArray
from conformodal.geometry import normalise_quat

from .mixtures import MAX_HYPOTHESES, PoseMixture

# probability below which a hypothesis is dropped, unless it is the most probable one. Chosen on seeds 20 and 21:
# at 1e-4, frames without the true room make the corridor's path 4 times worse
MIN_MASS = 1e-6
# two peaks of a softmax are two modes where the probability between them falls below this share of the lower one
_VALLEY_SHARE = 0.5
# standard deviation of the norm of a quaternion whose components were chosen one by one: the further from one, the
# less they fit together
_NORM_SIGMA = 0.1

Probabilities: TypeAlias = Sequence[RealArray]


def mode_mixtures(proba: Probabilities, bins: QuantileBins) -> list[PoseMixture]:
    """Mixtures of every frame: the modes of the softmax, seven arrays (n, K_j) over the bins of the targets."""
    mixtures = []
    for i in range(len(proba[0])):
        rows = [p[i].astype(np.float64) for p in proba]
        targets = [_described(p, _basins(p), e) for p, e in zip(rows, bins.edges_, strict=True)]
        mixtures.append(_combine(targets, np.log(MIN_MASS)))
    return mixtures


def interval_mixtures(proba: Probabilities, regions: Regions) -> list[PoseMixture]:
    """Mixtures of every frame: the most probable cuboids of its region, each at the means of its intervals.

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
        best = np.argsort(-total, kind="stable")[:MAX_HYPOTHESES]
        left, right = np.divmod(best, len(runs.log_mass))
        mean = np.column_stack((mean[left], runs.mean[right]))
        spread = np.column_stack((spread[left], runs.spread[right]))
        log_mass = total[best]
    return BinRuns(mean, spread, log_mass)


def _combine(targets: list[BinRuns], least_log_mass: float) -> PoseMixture:
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
    best = np.argsort(-mass, axis=None, kind="stable")[:MAX_HYPOTHESES]
    best = best[mass.flat[best] >= min(least_log_mass, mass.flat[best[0]])]
    at, facing = np.unravel_index(best, mass.shape)
    poses = places.mean[at], places.spread[at], unit[facing], turn[facing]
    return PoseMixture.weighted(*poses, mass[at, facing], measured=False)
