"""Regions of poses: the cuboids of a product set that hypotheses support.

Sets of single targets, multiplied, have cuboids that no evidence speaks for: the x of one room beside the y of another.
Of the product at level q only those cuboids stay that contain one of the hypotheses which together hold q of the
belief. These sets are nested in q, so the score of a pose is the smallest q whose set contains it, and split-conformal
calibration guarantees their coverage as that of any other score.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.conformal.checks import BinProbabilities
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray
from conformodal.geometry import fix_sign

from .candidates import Candidates
from .places import Place, summarise


@dataclass(frozen=True, eq=False)
class Support:
    """The hypotheses of one image that can support a cuboid, most probable first."""

    candidates: Candidates  # the m hypotheses; their probabilities are shares of the whole belief
    cells: IntArray  # (m, 7) cell of each target
    levels: FloatArray  # (m,) level of the region from which each counts: the probability of all that are more probable
    within: float = 1.0  # probability of the cells: the rest lies where no training frame was, or is turned as none was

    @property
    def out_of_range(self) -> bool:
        """Whether the image is most probably from beyond the cells."""
        return self.within < 0.5

    @classmethod
    def of(cls, candidates: Candidates, cells: QuantileBins, sign_reference: FloatArray) -> Self:
        """Of an image's hypotheses, without those beyond the cells."""
        hypotheses = candidates.normalised()
        hypotheses = hypotheses.take(np.argsort(-hypotheses.log_mass, kind="stable"))
        quats = fix_sign(hypotheses.orientations_quat_wxyz, sign_reference)
        codes = cells.encode(np.concatenate((hypotheses.positions_xyz, quats), axis=1))
        mass = np.exp(hypotheses.log_mass)
        within = np.flatnonzero((codes >= 0).all(axis=1))
        levels = np.concatenate(([0.0], np.cumsum(mass)[:-1]))
        return cls(hypotheses.take(within), codes[within], levels[within], float(mass[within].sum()))


class PoseRegions(Regions):
    """Regions of n poses: disjoint cuboids, not the product of the targets' sets.

    The sets of single targets, such as :meth:`intervals` and `masks`, are the projections of the cuboids.

    Parameters
    ----------
    bins, masks, unbounded
        Of the product of the targets' sets, see :class:`~conformodal.conformal.Regions`.
    supports
        The hypotheses of each image.
    limits
        (n,) level up to which hypotheses count.
    product
        Whether the region is all of the product, as where each target is calibrated by itself. Its places are still the
        cuboids that hypotheses support.
    """

    def __init__(
        self,
        bins: QuantileBins,
        masks: Sequence[BoolArray],
        unbounded: BoolArray,
        supports: Sequence[Support],
        limits: RealArray,
        *,
        product: bool = False,
    ) -> None:
        super().__init__(bins, masks, unbounded)
        self.supports, self.limits, self.product = list(supports), np.asarray(limits), product
        self.boxes: list[IntArray] = []  # (b, 7, 2): first cell and one past the last
        projections = [np.zeros_like(mask) for mask in self.masks]
        for i, (support, limit) in enumerate(zip(self.supports, self.limits, strict=True)):
            runs = super().runs(i)
            boxes = _supported(runs, support, [mask[i] for mask in self.masks], limit)
            self.boxes.append(boxes)
            for j, mask in enumerate(projections):
                for low, high in boxes[:, j]:
                    mask[i, low:high] = True
        if not product:
            self.masks = [mask | unbounded[:, j, None] for j, mask in enumerate(projections)]
            self._stacked = None

    def __getitem__(self, index: slice | BoolArray | npt.NDArray[np.integer]) -> PoseRegions:
        """Regions of some of the images: a slice, a boolean mask or an array of positions."""
        part, rows = super().__getitem__(index), np.arange(len(self))[index].tolist()
        chosen = copy(self)
        vars(chosen).update(vars(part))
        chosen.supports, chosen.limits = [self.supports[i] for i in rows], self.limits[rows]
        chosen.boxes = [self.boxes[i] for i in rows]
        return chosen

    @classmethod
    def concatenate(cls, parts: Iterable[Regions]) -> PoseRegions:
        """Regions of all the images of `parts`, in order."""
        each = [part for part in parts if isinstance(part, PoseRegions)]
        whole = copy(each[0])
        vars(whole).update(vars(Regions.concatenate(each)))
        whole.supports = [support for part in each for support in part.supports]
        whole.limits = np.concatenate([part.limits for part in each])
        whole.boxes = [boxes for part in each for boxes in part.boxes]
        return whole

    def contains(self, y: npt.ArrayLike, joint: bool = False) -> BoolArray:
        """Whether each projection holds its value of `y`, (n, 7); with `joint`, whether the region holds the pose."""
        if not joint or self.product:
            return super().contains(y, joint)
        held, codes = super().contains(y, joint), self.bins.encode(np.asarray(y, dtype=np.float64))
        for i in np.flatnonzero(held & ~self.unbounded.all(axis=1)).tolist():
            low, high = self.boxes[i][:, :, 0], self.boxes[i][:, :, 1]
            held[i] = ((low <= codes[i]) & (codes[i] < high)).all(axis=1).any()
        return held

    def box_edges(self, i: int) -> FloatArray:
        """The cuboids (b, 7, 2) of image `i` in the targets' units, the one of the most probable hypothesis first."""
        edges = np.empty(self.boxes[i].shape)
        for j, target_edges in enumerate(self.bins.edges_):
            edges[:, j] = target_edges[self.boxes[i][:, j]]
        edges[:, self.unbounded[i]] = (-np.inf, np.inf)
        return edges

    def places(self, i: int) -> list[Place]:
        """The places of image `i`, most probable first, each with the cuboid that holds it.

        What is missing from the sum of their probabilities is that of elsewhere.
        """
        support, places = self.supports[i], []
        for (low, high), edges in zip(np.moveaxis(self.boxes[i], 2, 1), self.box_edges(i), strict=True):
            inside = ((support.cells >= low) & (support.cells < high)).all(axis=1)
            places.append(summarise(support.candidates.take(np.flatnonzero(inside)), edges))
        return sorted(places, key=lambda place: -place.probability)

    @property
    def n_places(self) -> IntArray:
        """(n,) number of cuboids."""
        return np.array([len(boxes) for boxes in self.boxes], dtype=np.int64)

    @property
    def volume(self) -> FloatArray:
        """(n,) sum over the cuboids of the product of their lengths."""
        if self.product:
            return super().volume
        volumes = np.array([np.ptp(self.box_edges(i), axis=2).prod(axis=1).sum() for i in range(len(self))])
        return np.where(self.unbounded.any(axis=1), np.inf, volumes)


def _supported(runs: list[IntArray], support: Support, masks: list[BoolArray], limit: float) -> IntArray:
    """The cuboids (b, 7, 2) that hypotheses support, that of the most probable one first."""
    inside = np.all([mask[at] for mask, at in zip(masks, support.cells.T, strict=True)], axis=0)
    cells = support.cells[inside & (support.levels <= limit)]
    if not len(cells):
        return np.empty((0, len(runs), 2), dtype=np.int64)
    columns = zip(runs, cells.T, strict=True)
    boxes = np.stack([run[np.searchsorted(run[:, 0], at, side="right") - 1] for run, at in columns], axis=1)
    _, first = np.unique(boxes, axis=0, return_index=True)
    return np.asarray(boxes[np.sort(first)])


def pose_regions(
    rule: SplitConformal, proba: Sequence[RealArray], supports: Sequence[Support], thresholds: RealArray
) -> PoseRegions:
    """Regions of n images at thresholds (n, 7), or (7,), of the rule's score.

    `proba` are seven arrays (n, cells), see :meth:`~conformodal.localizer.belief.Beliefs.marginals`.
    """
    product = rule.regions_at(BinProbabilities(proba), thresholds)
    limits = np.broadcast_to(thresholds, product.unbounded.shape)
    limits = limits.min(axis=1) if _in_shares(rule) else np.full(len(product), np.inf)
    return PoseRegions(product.bins, product.masks, product.unbounded, supports, limits, product=rule.joint != "max")


def pose_scores(
    rule: SplitConformal, proba: Sequence[FloatArray], supports: Sequence[Support], targets: FloatArray
) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7), with which :func:`pose_regions` agrees.

    Where all targets are calibrated together, a cuboid around the pose grows with the level until it contains a
    hypothesis that counts: the largest score of a pose is the level that it takes.
    """
    scores = rule.score_samples(BinProbabilities(proba), targets)
    if rule.joint != "max":
        return scores
    columns = [rule.scores_of(p, w) for p, w in zip(proba, rule.bins.widths, strict=True)]
    loc, scale = rule.scales()
    scaled = [(column - a) / b for column, a, b in zip(columns, loc, scale, strict=True)]
    codes, in_shares = rule.bins.encode(targets), _in_shares(rule)
    least = np.full(len(scores), np.inf)
    for i, support in enumerate(supports):
        if (codes[i] < 0).any() or not len(support.levels):
            continue
        levels = support.levels if in_shares else np.full(len(support.levels), -np.inf)
        for column, at, cells in zip(scaled, codes[i], support.cells.T, strict=True):
            levels = np.maximum(levels, _highest_between(column[i], int(at), cells))
        least[i] = levels.min()
    rows, largest = np.arange(len(scores)), np.argmax((scores - loc) / scale, axis=1)
    raised = scores.astype(np.float64)
    raised[rows, largest] = least * scale[largest] + loc[largest]
    return raised


def _highest_between(row: FloatArray, at: int, cells: IntArray) -> FloatArray:
    """(m,) largest entry of a row between one cell and each of m others, both ends included."""
    up, down = np.maximum.accumulate(row[at:]), np.maximum.accumulate(row[at::-1])
    return np.where(cells >= at, up[np.maximum(cells - at, 0)], down[np.maximum(at - cells, 0)])


def _in_shares(rule: SplitConformal) -> bool:
    """Whether thresholds are shares of the belief, as levels of hypotheses are."""
    return rule.joint == "max" and bool(getattr(rule.score_, "normalised", False))
