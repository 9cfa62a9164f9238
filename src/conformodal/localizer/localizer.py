"""Pose sources that learnt from the same frames, and their joint belief about an image.

A belief is the probability distribution of an image's pose, a mixture of the softmax and absolute pose estimates.
Regions are calibrated from its marginals over fine cells; its hypotheses are the candidates of the path.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Self

import numpy as np

from conformodal.conformal import QuantileBins, Regions
from conformodal.conformal.scores import Aps
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray
from conformodal.core.parallel import in_threads, in_workers, raise_if_cancelled, release_freed_memory
from conformodal.core.progress import stage_of

from . import LocalizationError
from .cells import BeliefCells, divide_bins
from .evidence import FrameEvidence, PoseMeasurement
from .fusion import fuse
from .mixtures import PoseMixture
from .modes import mode_mixtures
from .observations import Posterior
from .regions import Support
from .sources.registry import CarriesLandmarks, PoseSource, TurnsImages, find_source
from .training_data import TrainingData

_IMAGES_AT_A_TIME = 128  # seven times some thousand cells each
RECOGNISED = 0.9  # inlier probability from which an estimate by local features is a recognised place
# A source is asked beside a recognised place if the standard deviation of its best estimates is at most so many times
# that of the place: the product then has a standard deviation smaller by a sixth or more. With 3, the network runs for
# more images of redkitchen `blocks` (seed 20) and fr1_xyz (seed 22), and errors differ by less than a hundredth
_USEFUL = 1.5
# least share of the image's own belief in a region from a posterior. Chosen on seeds 20 to 22 of redkitchen `blocks`
# and 20 of the demo
_MIN_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Beliefs about the poses of n images."""

    proba: list[RealArray]  # seven arrays (n, K_j): the softmax over the bins
    mixtures: Sequence[PoseMixture]  # image by image
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
        sure = [recognised_only(estimates) for estimates in self.estimates]
        return np.array([max((one.n_inliers * one.image_share for one in each), default=0.0) for each in sure])

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The beliefs of all parts, in order."""
        proba = [np.concatenate(blocks) for blocks in zip(*(part.proba for part in parts), strict=True)]
        mixtures = [mixture for part in parts for mixture in part.mixtures]
        return cls(proba, mixtures, [each for part in parts for each in part.estimates])

    def part(self, rows: slice | IntArray) -> Beliefs:
        """The beliefs about some of the images."""
        numbers = np.arange(len(self))[rows].tolist()
        mixtures, estimates = [self.mixtures[i] for i in numbers], [self.estimates[i] for i in numbers]
        return Beliefs([p[rows] for p in self.proba], mixtures, estimates)

    def after(self, posteriors: Sequence[Posterior]) -> Beliefs:
        """The beliefs once other frames are known: each posterior, and where it is wrong, the image's own belief.

        The latter keeps a share whatever the posterior claims, which may be sure and wrong through a whole stretch.
        """
        pairs = zip(posteriors, self.mixtures, strict=True)
        mixtures = [posterior.with_image(mixture, _MIN_SHARE) for posterior, mixture in pairs]
        return Beliefs(self.proba, mixtures, self.estimates)

    def marginals(self, cells: BeliefCells) -> list[FloatArray]:
        """Seven arrays (n, cells) of probabilities whose rows sum to one."""
        return cells.marginals(np.concatenate(self.proba, axis=1), self.mixtures)


@dataclass(frozen=True, eq=False)
class Localizer:
    """From evidence to beliefs, by sources in the order of fusion: a later one's inlier takes precedence."""

    sources: tuple[PoseSource, ...]
    bins: QuantileBins  # of the seven targets
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions
    depth_m: float = math.nan  # median depth of the scene; NaN where it is not known

    def __post_init__(self) -> None:
        names = [source.name for source in self.sources]
        if not names or len(set(names)) < len(names):
            raise LocalizationError(f"a localizer needs sources of different names, at least one, got {names}")

    @classmethod
    def fit_each(cls, data: TrainingData, parts: Sequence[IntArray], names: Sequence[str]) -> list[Self]:
        """A localizer for each part (m,) of the frames, which learns from it alone; without sources that cannot.

        Sources learn in threads. Those that use local features learn from the last part first, by default all frames,
        since the other parts share its matches; then from several of these at once, in workers if there are any. Each
        of the other sources learns from one part after another, so that it holds the features of one.
        """
        kinds = [find_source(name) for name in names]
        every, fit = range(len(parts)), partial(_fit, data, parts)
        first = [(kind, every[-1:] if kind.local else every) for kind in sorted(kinds, key=lambda kind: not kind.local)]
        others = [(kind, [k]) for k in every[:-1] for kind in kinds if kind.local]
        fitted: dict[tuple[type[PoseSource], int], PoseSource | None] = {}
        results = in_threads(fit, first)
        release_freed_memory()  # else the folds' maps would come on top of what networks took
        results += in_workers(fit, others, stage_of(data.progress, "folds"))
        release_freed_memory()
        for (kind, numbers), sources in zip([*first, *others], results, strict=True):
            fitted.update({(kind, k): source for k, source in zip(numbers, sources, strict=True)})
        localizers = []
        for k, frames in enumerate(parts):
            learnt = tuple(source for kind in kinds if (source := fitted[kind, k]) is not None)
            localizers.append(cls(learnt, data.bins_of(frames), data.sign_reference, data.depth.median_m))
        return localizers

    @property
    def frames(self) -> IntArray:
        """Frames of the training data that at least one source has learnt from, increasing."""
        return np.unique(np.concatenate([source.frames for source in self.sources]))

    @property
    def local(self) -> bool:
        """Whether a source uses local features."""
        return any(source.local for source in self.sources)

    @property
    def carrying_source(self) -> CarriesLandmarks | None:
        """The only source that uses local features, if it works with corners that were followed."""
        local = [source for source in self.sources if source.local]
        only = local[0] if len(local) == 1 else None
        return only if isinstance(only, CarriesLandmarks) and only.carries else None

    @cached_property
    def cells(self) -> QuantileBins:
        """Cells of the beliefs' marginals."""
        return divide_bins(self.bins, self.depth_m)

    @cached_property
    def _belief_cells(self) -> BeliefCells:
        return BeliefCells.of(self.bins, self.cells, self.sign_reference)

    @cached_property
    def _anywhere(self) -> PoseMixture:
        """The mode of an even softmax."""
        return mode_mixtures([np.full((1, k), 1 / k) for k in self.bins.sizes], self.bins)[0]

    def turn_for(self, position_xyz: FloatArray, quat_wxyz: FloatArray) -> float:
        """Angle in radians by which to turn an image from about a pose, for the sources that use local features."""
        turns = [source.turn_for(position_xyz, quat_wxyz) for source in self.sources if isinstance(source, TurnsImages)]
        return next(iter(turns), 0.0)

    def beliefs(self, evidence: FrameEvidence) -> Beliefs:
        """Beliefs about the poses of n images.

        Sources that use local features answer first. Where they recognise a place, others are asked only if their best
        estimates could change the answer: their features need not be computed otherwise. What the estimates leave
        spreads evenly.
        """
        n, measurements = len(evidence), dict[str, list[Sequence[PoseMeasurement]]]()
        densities: list[tuple[IntArray, list[RealArray]]] = []

        def ask(source: PoseSource, rows: IntArray) -> None:
            if rows.size:
                answer = source.answer(evidence if len(rows) == n else evidence.part(rows))
                if answer.measurements:
                    by_image = dict(zip(rows.tolist(), answer.measurements, strict=True))
                    measurements[source.name] = [by_image.get(i, ()) for i in range(n)]
                if answer.proba is not None:
                    densities.append((rows, answer.proba))

        for source in (one for one in self.sources if one.local):
            ask(source, np.arange(n))
        estimates = [[one for answer in measurements.values() for one in answer[i]] for i in range(n)]
        sigma_m = np.array([_best_sigma_m(each) for each in estimates])
        for source in (one for one in self.sources if not one.local):
            useful = source.least_sigma_m <= _USEFUL * sigma_m
            ask(source, np.flatnonzero(np.isinf(sigma_m) if evidence.busy else useful))
        in_order = [measurements[source.name] for source in self.sources if source.name in measurements]
        proba, told = self._density(densities, n), sorted({i for rows, _ in densities for i in rows.tolist()})
        modes = dict(zip(told, mode_mixtures([p[told] for p in proba], self.bins), strict=True)) if told else {}
        mixtures = [fuse(modes.get(i, self._anywhere), [answer[i] for answer in in_order]) for i in range(n)]
        return Beliefs(proba, mixtures, estimates)

    def _density(self, densities: Sequence[tuple[IntArray, list[RealArray]]], n: int) -> list[RealArray]:
        """The mean of the softmaxes of each image; the distribution of the training frames where no source has one."""
        proba, dtype = [], densities[0][1][0].dtype if densities else np.dtype(np.float64)
        for j, k in enumerate(self.bins.sizes):
            total, count = np.zeros((n, k), dtype), np.zeros((n, 1))
            for rows, columns in densities:
                total[rows] += columns[j]
                count[rows] += 1
            proba.append(np.where(count > 0, total / np.maximum(count, 1), 1 / k).astype(dtype))
        return proba

    def marginals(self, beliefs: Beliefs) -> list[FloatArray]:
        """Seven arrays (n, cells), see :meth:`Beliefs.marginals`."""
        return beliefs.marginals(self._belief_cells)

    def level_set(self, beliefs: Beliefs, score: Aps, limits: FloatArray) -> Regions | None:
        """See :meth:`.cells.BeliefCells.level_set`, of one belief."""
        [mixture], proba = beliefs.mixtures, np.concatenate(beliefs.proba, axis=1)[0]
        mask = self._belief_cells.level_set(proba, mixture, score, limits)
        if mask is None:
            return None
        return Regions(self.cells, self._belief_cells.by_target(mask[None]), np.isposinf(limits)[None])

    def supports(self, beliefs: Beliefs) -> list[Support]:
        """What supports the cuboids of each image's region: its hypotheses as cells."""
        return [Support.of(mixture, self.cells, self.sign_reference) for mixture in beliefs.mixtures]

    def marginals_by_part(self, beliefs: Beliefs) -> Iterator[tuple[slice, list[FloatArray]]]:
        """The marginals in chunks of images, with the rows of each chunk: all at once would take much memory."""
        for start in range(0, max(len(beliefs), 1), _IMAGES_AT_A_TIME):
            rows = slice(start, start + _IMAGES_AT_A_TIME)
            yield rows, self.marginals(beliefs.part(rows))


def _fit(
    data: TrainingData, parts: Sequence[IntArray], job: tuple[type[PoseSource], Sequence[int]]
) -> list[PoseSource | None]:
    """A kind of sources that learns from parts of the frames, one after another."""
    kind, numbers = job
    sources = []
    for k in numbers:
        raise_if_cancelled()
        sources.append(kind.fit(data, parts[k]))
    return sources


def recognised_only(estimates: Sequence[PoseMeasurement]) -> list[PoseMeasurement]:
    """The estimates of an image that are probably inliers."""
    return [one for one in estimates if one.inlier_probability >= RECOGNISED]


def _best_sigma_m(estimates: Sequence[PoseMeasurement]) -> float:
    """Standard deviation of the best estimate that is probably an inlier; infinite without one."""
    return min((one.sigma_m for one in recognised_only(estimates)), default=math.inf)
