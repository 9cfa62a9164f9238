"""Regions of poses: the cuboids of a product set that hypotheses support.

Sets of single targets, multiplied, have cuboids that no evidence speaks for: the x of one room beside the y of another.
Of the product at level q only those cuboids stay that contain one of the hypotheses which together hold q of the
belief. These sets are nested in q, so the score of a pose is the smallest q whose set contains it, and split-conformal
calibration guarantees their coverage as that of any other score.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, Regions, SplitConformal
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
        its = candidates.normalised()
        its = its.take(np.argsort(-its.log_mass, kind="stable"))
        quats = fix_sign(its.orientations_quat_wxyz, sign_reference)
        codes = cells.encode(np.concatenate((its.positions_xyz, quats), axis=1))
        mass = np.exp(its.log_mass)
        within = np.flatnonzero((codes >= 0).all(axis=1))
        levels = np.concatenate(([0.0], np.cumsum(mass)[:-1]))
        return cls(its.take(within), codes[within], levels[within], float(mass[within].sum()))


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
        kept = [np.zeros_like(mask) for mask in self.masks]
        for i, (support, limit) in enumerate(zip(self.supports, self.limits, strict=True)):
            runs = super().runs(i)
            boxes = _supported(runs, support, [mask[i] for mask in self.masks], limit)
            self.boxes.append(boxes)
            for j, mask in enumerate(kept):
                for low, high in boxes[:, j]:
                    mask[i, low:high] = True
        if not product:
            self.masks = [mask | unbounded[:, j, None] for j, mask in enumerate(kept)]
            self._stacked = None

    def __getitem__(self, index: slice | BoolArray | npt.NDArray[np.integer]) -> PoseRegions:
        """Regions of some of the images: a slice, a boolean mask or an array of positions."""
        part = super().__getitem__(index)
        rows = np.arange(len(self))[index]
        chosen = [self.supports[i] for i in rows]
        return PoseRegions(self.bins, part.masks, part.unbounded, chosen, self.limits[rows], product=self.product)

    @classmethod
    def concatenate(cls, parts: Iterable[Regions]) -> PoseRegions:
        """Regions of all the images of `parts`, in order."""
        its = [part for part in parts if isinstance(part, PoseRegions)]
        if len(its) == 1:
            return its[0]
        whole = Regions.concatenate(its)
        supports = [support for part in its for support in part.supports]
        limits = np.concatenate([part.limits for part in its])
        return cls(whole.bins, whole.masks, whole.unbounded, supports, limits, product=its[0].product)

    def contains(self, y: npt.ArrayLike, joint: bool = False) -> BoolArray:
        """Whether each projection holds its value of `y`, (n, 7); with `joint`, whether the region holds the pose."""
        if not joint or self.product:
            return super().contains(y, joint)
        values = np.asarray(y, dtype=np.float64)
        return np.array([self.holds(i, values[i : i + 1])[0] for i in range(len(self))], dtype=np.bool_)

    def holds(self, i: int, y: npt.ArrayLike, n_targets: int = 7) -> BoolArray:
        """(k,) whether the region of image `i` holds each of k poses (k, 7), or their first targets: 3, positions."""
        codes, boxes = self.bins.encode(np.asarray(y, dtype=np.float64))[:, :n_targets, None], self.boxes[i]
        if self.unbounded[i, :n_targets].all():
            return np.ones(len(codes), dtype=np.bool_)
        if self.product:
            runs = zip(self.runs(i)[:n_targets], codes[:, :, 0].T, strict=True)
            inside = [((run[:, 0] <= at[:, None]) & (at[:, None] < run[:, 1])).any(axis=1) for run, at in runs]
            return np.asarray((np.array(inside).T | self.unbounded[i, :n_targets]).all(axis=1))
        low, high = np.moveaxis(boxes[:, :n_targets], 2, 0)
        return np.asarray(((codes >= low.T) & (codes < high.T)).all(axis=1).any(axis=1))

    def box_edges(self, i: int) -> FloatArray:
        """The cuboids (b, 7, 2) of image `i` in the targets' units, the one of the most probable hypothesis first."""
        edges = np.empty(self.boxes[i].shape)
        for j, its in enumerate(self.bins.edges_):
            edges[:, j] = its[self.boxes[i][:, j]]
        edges[:, self.unbounded[i]] = (-np.inf, np.inf)
        return edges

    def places(self, i: int) -> list[Place]:
        """The places of image `i`, most probable first, each with the cuboid that holds it.

        What is missing from the sum of their probabilities is that of elsewhere.
        """
        its, found = self.supports[i], []
        for (low, high), edges in zip(np.moveaxis(self.boxes[i], 2, 1), self.box_edges(i), strict=True):
            inside = ((its.cells >= low) & (its.cells < high)).all(axis=1)
            found.append(summarise(its.candidates.take(np.flatnonzero(inside)), edges))
        return sorted(found, key=lambda place: -place.probability)

    @property
    def n_places(self) -> IntArray:
        """(n,) number of cuboids."""
        return np.array([len(boxes) for boxes in self.boxes], dtype=np.int64)

    @property
    def volume(self) -> FloatArray:
        """(n,) sum over the cuboids of the product of their lengths."""
        if self.product:
            return super().volume
        found = np.array([np.ptp(self.box_edges(i), axis=2).prod(axis=1).sum() for i in range(len(self))])
        return np.where(self.unbounded.any(axis=1), np.inf, found)


def _supported(runs: list[IntArray], support: Support, masks: list[BoolArray], limit: float) -> IntArray:
    """The cuboids (b, 7, 2) that hypotheses support, that of the most probable one first."""
    inside = np.all([mask[at] for mask, at in zip(masks, support.cells.T, strict=True)], axis=0)
    cells = support.cells[inside & (support.levels <= limit)]
    if not len(cells):
        return np.empty((0, len(runs), 2), dtype=np.int64)
    its = zip(runs, cells.T, strict=True)
    boxes = np.stack([run[np.searchsorted(run[:, 0], at, side="right") - 1] for run, at in its], axis=1)
    _, first = np.unique(boxes, axis=0, return_index=True)
    return np.asarray(boxes[np.sort(first)])


def pose_regions(
    rule: SplitConformal, proba: Sequence[RealArray], supports: Sequence[Support], thresholds: RealArray
) -> PoseRegions:
    """Regions of n images at thresholds (n, 7), or (7,), of the rule's score.

    `proba` are seven arrays (n, cells), see :meth:`~conformodal.localizer.belief.Beliefs.marginals`.
    """
    found = rule.regions_at(list(proba), thresholds)
    limits = np.broadcast_to(thresholds, found.unbounded.shape)
    limits = limits.min(axis=1) if _in_shares(rule) else np.full(len(found), np.inf)
    return PoseRegions(found.bins, found.masks, found.unbounded, supports, limits, product=rule.joint != "max")


def pose_scores(
    rule: SplitConformal, proba: Sequence[FloatArray], supports: Sequence[Support], targets: FloatArray
) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7), with which :func:`pose_regions` agrees.

    Where all targets are calibrated together, a cuboid around the pose grows with the level until it contains a
    hypothesis that counts: the largest score of a pose is the level that it takes.
    """
    own = rule.score_samples(list(proba), targets)
    if rule.joint != "max":
        return own
    columns = [rule.scores_of(p, w) for p, w in zip(proba, rule.bins.widths, strict=True)]
    loc, scale = rule.rule.loc_, rule.rule.scale_
    scaled = [(column - a) / b for column, a, b in zip(columns, loc, scale, strict=True)]
    codes, in_shares = rule.bins.encode(targets), _in_shares(rule)
    least = np.full(len(own), np.inf)
    for i, support in enumerate(supports):
        if (codes[i] < 0).any() or not len(support.levels):
            continue
        levels = support.levels if in_shares else np.full(len(support.levels), -np.inf)
        for column, at, cells in zip(scaled, codes[i], support.cells.T, strict=True):
            levels = np.maximum(levels, _highest_between(column[i], int(at), cells))
        least[i] = levels.min()
    rows, largest = np.arange(len(own)), np.argmax((own - loc) / scale, axis=1)
    found = own.astype(np.float64)
    found[rows, largest] = least * scale[largest] + loc[largest]
    return found


def _highest_between(row: FloatArray, at: int, cells: IntArray) -> FloatArray:
    """(m,) largest entry of a row between one cell and each of m others, both ends included."""
    up, down = np.maximum.accumulate(row[at:]), np.maximum.accumulate(row[at::-1])
    return np.where(cells >= at, up[np.maximum(cells - at, 0)], down[np.maximum(at - cells, 0)])


def _in_shares(rule: SplitConformal) -> bool:
    """Whether thresholds are shares of the belief, as levels of hypotheses are."""
    return rule.joint == "max" and bool(getattr(rule.score, "normalised", False))
