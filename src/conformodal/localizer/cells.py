"""Marginals of beliefs over fine cells, and their level sets.

A belief is a mixture: what its hypotheses leave spreads over the bins as the softmax says. Its marginals are
probabilities of cells, of which some thousand divide the range of each target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from conformodal.conformal import QuantileBins
from conformodal.conformal.scores import Aps
from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, RealArray
from conformodal.geometry import fix_sign

from .mixtures import PoseMixture

_CELLS = 800  # per target, at least: estimates are more precise than bins
# Cells of positions are no wider than this share of the scene's depth, however large the world. But bins may bridge the
# space between rooms: they have so many such cells at each end, where frames may be, and some wider ones between
_WIDEST, _AT_EACH_END, _BETWEEN = 1 / 400, 128, 16
# cells beyond the bins at each end, each wider than the one before by this factor: poses may be where no training
# frame was. They reach 2.4 times as far as the 800 cells
BEYOND, _WIDER = 300, 1.01
# How far they reach at least, where targets hardly change in training: in scene depths, or metres where none is known,
# and of a quaternion's component
_LEAST_REACH_DEPTHS, _LEAST_REACH_QUAT = 1.0, 0.3
_NEGLIGIBLE = 1e-3  # hypotheses of less probability are left out of the marginals
_MIN_ANGLE = 1e-4
# Standard deviations around hypotheses within which the densest cells are sought, and how many cells that may be
_WINDOW_SIGMAS, _WINDOW_CELLS = 8.0, 4000
_ROUNDING = 1e-9  # of densities, relative


class _Hypotheses(NamedTuple):
    """Hypotheses of a mixture that stand for themselves, as Student's t distributions of the seven targets."""

    weights: FloatArray  # (m,)
    places: FloatArray  # (m, 7)
    sigmas: FloatArray  # (m, 7)

    @property
    def left(self) -> float:
        """The probability that they leave to the softmax."""
        return float(1 - self.weights.sum())

    def below(self, values: FloatArray, target: IntArray) -> FloatArray:
        """Probability (k,) of what lies below values (k,) of these targets (k,)."""
        places, sigmas = (np.take(part, target, axis=1) for part in (self.places, self.sigmas))
        return np.asarray(self.weights @ _student_cdf((values - places) / sigmas))

    def density(self, values: FloatArray) -> FloatArray:
        """Density (7,) at one value of each target, (7,)."""
        away = (values - self.places) / self.sigmas
        return np.asarray(self.weights @ (2 / (math.pi * math.sqrt(3)) / (1 + away**2 / 3) ** 2 / self.sigmas))


@dataclass(frozen=True, eq=False)
class BeliefCells:
    """The cells of the marginals, those of all targets one after another; so are the bins."""

    edges: FloatArray  # (C + 7,) of the cells of the first target, then of the second, and so on
    widths: FloatArray  # (C,)
    target: IntArray  # (C + 7,) of each edge
    upper: IntArray  # (C,) the upper edge of each cell
    starts: IntArray  # (7,) first cell of each target
    sizes: IntArray  # (7,) cells of each
    bin_of: IntArray  # (C,) bin of each cell; any beyond the bins
    share: FloatArray  # (C,) of its bin's probability that a cell has: 0 beyond the bins
    bin_starts: IntArray  # (7,) first bin of each target
    densest: FloatArray  # (bins,) largest density of a cell of a bin whose probability is 1
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions

    @classmethod
    def of(cls, bins: QuantileBins, cells: QuantileBins, sign_reference: FloatArray) -> Self:
        """Of the cells that :func:`divide_bins` makes of the bins."""
        sizes, n_bins, widths = np.array(cells.sizes), np.array(bins.sizes), np.concatenate(cells.widths)
        starts, bin_starts, numbers = np.cumsum(sizes) - sizes, np.cumsum(n_bins) - n_bins, np.arange(len(sizes))
        bin_of, share = [], []
        for coarse, fine, before in zip(bins.edges_, cells.edges_, bin_starts.tolist(), strict=True):
            at = np.searchsorted(coarse, fine[:-1], side="right") - 1
            inside = (at >= 0) & (at < len(coarse) - 1)
            at[~inside] = 0
            share.append(np.where(inside, 1 / np.bincount(at[inside], minlength=len(coarse) - 1)[at], 0.0))
            bin_of.append(before + at)
        densest = np.zeros(n_bins.sum())
        np.maximum.at(densest, np.concatenate(bin_of), np.concatenate(share) / widths)
        return cls(
            edges=np.concatenate(cells.edges_),
            widths=widths,
            target=np.repeat(numbers, sizes + 1),
            upper=np.arange(sizes.sum()) + np.repeat(numbers, sizes) + 1,
            starts=starts,
            sizes=sizes,
            bin_of=np.concatenate(bin_of),
            share=np.concatenate(share),
            bin_starts=bin_starts,
            densest=densest,
            sign_reference=sign_reference,
        )

    def by_target(self, values: AnyArray) -> list[AnyArray]:
        """Arrays (n, cells) of each target, from values (n, C)."""
        ends = self.starts + self.sizes
        return [values[:, a:b] for a, b in zip(self.starts.tolist(), ends.tolist(), strict=True)]

    def marginals(self, proba: RealArray, mixtures: Sequence[PoseMixture]) -> list[FloatArray]:
        """Seven arrays (n, cells) of probabilities whose rows sum to one, from softmaxes (n, bins)."""
        block = np.take(proba, self.bin_of, axis=1) * self.share
        for i, mixture in enumerate(mixtures):
            hypotheses = self._hypotheses(mixture)
            if hypotheses is not None:
                below = hypotheses.below(self.edges, self.target)
                block[i] *= hypotheses.left
                # far away, rounding makes some differences negative
                block[i] += np.maximum(below[self.upper] - below[self.upper - 1], 0)
        block /= np.repeat(np.add.reduceat(block, self.starts, axis=1), self.sizes, axis=1)
        return self.by_target(block)

    def level_set(self, proba: RealArray, mixture: PoseMixture, score: Aps, limits: FloatArray) -> BoolArray | None:
        """The cells (C,) whose score is at most the limit of their target (7,), from one softmax (bins,) and mixture.

        It is that of the :meth:`marginals`, found from cells near the hypotheses alone: no other is as dense as those
        that are ranked. None where these cells do not hold more than the limits.
        """
        if np.isposinf(limits).all():
            return np.ones(len(self.share), dtype=np.bool_)
        hypotheses = self._hypotheses(mixture)
        if hypotheses is None or score.order != "density" or score.share is None:
            return None
        reach = _WINDOW_SIGMAS * hypotheses.sigmas
        first, end = self._window((hypotheses.places - reach).min(axis=0), (hypotheses.places + reach).max(axis=0))
        counts = end - first
        if counts.sum() > _WINDOW_CELLS:
            return None
        before, targets = np.cumsum(counts) - counts, np.arange(len(counts))
        target = np.repeat(targets, counts)
        cell = np.arange(counts.sum()) + np.repeat(self.starts + first - before, counts)
        # one edge more than cells
        edge = np.arange(counts.sum() + len(counts)) + np.repeat(self.starts + first - before, counts + 1)
        below = hypotheses.below(self.edges[edge], np.repeat(targets, counts + 1))
        upper = np.arange(len(cell)) + target + 1
        bins, widths = self.bin_of[cell], self.widths[cell]
        mass = hypotheses.left * proba[bins] * self.share[cell] + np.maximum(below[upper] - below[upper - 1], 0)
        lowest, highest = self.starts + targets, self.starts + targets + self.sizes
        inside = hypotheses.below(self.edges[highest], targets) - hypotheses.below(self.edges[lowest], targets)
        totals = hypotheses.left * np.add.reduceat(proba, self.bin_starts, dtype=np.float64) + inside
        if not (totals > 0).all():  # all of it lies beyond the cells
            return None
        mass /= totals[target]
        # hypotheses are in the windows, so that beyond these they are nowhere denser than at their ends
        at_ends = [hypotheses.density(self.edges[lowest + at]) for at in (first, end)]
        densest = hypotheses.left * np.maximum.reduceat(proba * self.densest, self.bin_starts) + np.maximum(*at_ends)
        chosen = score.level_set_above(mass, widths, limits, before, (1 + _ROUNDING) * densest / totals)
        if not chosen.complete.all():
            return None
        mask = np.zeros(len(self.share), dtype=np.bool_)
        mask[cell[chosen.mask]] = True
        return mask

    def _window(self, low: FloatArray, high: FloatArray) -> tuple[IntArray, IntArray]:
        """First cell and one past the last of each target (7,) that cover values (7,) to others; one at least."""
        first, end = np.empty_like(self.starts), np.empty_like(self.starts)
        for j, (start, size) in enumerate(
            zip((self.starts + np.arange(len(self.starts))).tolist(), self.sizes.tolist(), strict=True)
        ):
            a, b = np.searchsorted(self.edges[start : start + size + 1], (low[j], high[j]))
            first[j] = min(max(int(a) - 1, 0), size - 1)
            end[j] = max(min(int(b), size), first[j] + 1)
        return first, end

    def _hypotheses(self, mixture: PoseMixture) -> _Hypotheses | None:
        """Those of a mixture that count; None without any."""
        weights = mixture.weights
        rows = mixture.measured & (weights > _NEGLIGIBLE)
        if not rows.any():
            return None
        quats = fix_sign(mixture.orientations_quat_wxyz[rows], self.sign_reference)
        # a rotation by a small angle moves a unit quaternion by half of it, orthogonally to itself
        angle = mixture.orientation_spreads_rad[rows, None] / 2 * np.sqrt(np.maximum(1 - quats**2, _MIN_ANGLE))
        places = np.concatenate((mixture.positions_xyz[rows], quats), axis=1)
        return _Hypotheses(weights[rows], places, np.concatenate((mixture.position_spreads[rows], angle), axis=1))


def divide_bins(bins: QuantileBins, depth_m: float = math.nan) -> QuantileBins:
    """Cells that divide the bins, and wider and wider cells beyond them; edges of bins are edges of cells.

    Those of positions are fine for the scene's median depth, if it is known: else a room has few of a building's cells.
    Those beyond the bins reach some way even where a target never changes, like the height of a wheeled robot: no
    estimate is that exact.
    """
    least, growth, edges = max(1, -(-_CELLS // max(bins.sizes))), np.cumsum(_WIDER ** np.arange(1, BEYOND + 1)), []
    for j, coarse in enumerate(bins.edges_):
        widest = _WIDEST * depth_m if j < 3 and math.isfinite(depth_m) else math.inf
        parts = [_divided(*ends, least, widest) for ends in zip(coarse[:-1].tolist(), coarse[1:].tolist(), strict=True)]
        fine = np.append(np.concatenate(parts), coarse[-1])
        steps = (fine[-1] - fine[0]) / (least * bins.sizes[j]) * growth
        depth = depth_m if math.isfinite(depth_m) else 1.0
        steps *= max(1.0, (_LEAST_REACH_DEPTHS * depth if j < 3 else _LEAST_REACH_QUAT) / steps[-1])
        edges.append(np.concatenate((fine[0] - steps[::-1], fine, fine[-1] + steps)))
    return QuantileBins.from_edges(edges)


def _divided(low: float, high: float, least: int, widest: float) -> FloatArray:
    """Lower edges of the cells of a bin."""
    count = max(least, math.ceil(min((high - low) / widest, 1e9)))
    if count <= 2 * _AT_EACH_END + _BETWEEN:
        return np.linspace(low, high, count, endpoint=False)
    end = widest * np.arange(_AT_EACH_END + 1)
    return np.concatenate(
        (low + end, np.linspace(low + end[-1], high - end[-1], _BETWEEN + 1)[1:-1], high - end[:0:-1])
    )


def _student_cdf(x: FloatArray) -> FloatArray:
    """Student's t with three degrees of freedom: large errors are more common than under a normal distribution."""
    scaled = x / math.sqrt(3)
    ratio = scaled * scaled
    ratio += 1
    np.divide(scaled, ratio, out=ratio)
    ratio += np.arctan(scaled, out=scaled)
    ratio *= 1 / math.pi
    ratio += 0.5
    return ratio
