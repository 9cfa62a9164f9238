"""Pose sources that learnt from the same frames, and their joint belief about an image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import FloatArray, IntArray, RealArray
from conformodal.core.parallel import in_threads, raise_if_cancelled

from .belief import Beliefs, belief_cells
from .candidates import mode_candidates
from .errors import LocalizationError
from .evidence import FrameEvidence
from .fusion import fuse
from .regions import Support
from .sources.registry import PoseSource, SourceAnswer, SourceData, find_source

Source = TypeVar("Source", bound=PoseSource)

_IMAGES_AT_A_TIME = 256  # seven times some sixteen hundred cells each


@dataclass(frozen=True, eq=False)
class Localizer:
    """From evidence to beliefs, by sources in the order of fusion: a later one's inlier takes precedence."""

    sources: tuple[PoseSource, ...]
    bins: QuantileBins  # of the seven targets
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions

    def __post_init__(self) -> None:
        names = [source.name for source in self.sources]
        if not names or len(set(names)) < len(names):
            raise LocalizationError(f"a localizer needs sources of different names, at least one, got {names}")

    @classmethod
    def fit_each(cls, data: SourceData, parts: Sequence[IntArray], names: Sequence[str]) -> list[Self]:
        """A localizer for each part (m,) of the frames, which learns from it alone.

        A source that cannot be fitted is left out. Sources learn in threads. One that uses local features, which takes
        longest, learns several parts at once, the last part (by default all frames, whose matches the others share)
        before; others learn part after part: networks share random numbers.
        """
        kinds = [find_source(name) for name in names]

        def report(stage: str, done: int, total: int) -> None:
            raise_if_cancelled()
            if data.progress is not None:
                data.progress(stage, done, total)

        def fit(job: tuple[type[PoseSource], list[int]]) -> list[PoseSource | None]:
            kind, numbers = job
            sources = []
            for k in numbers:
                raise_if_cancelled()
                sources.append(kind.fit(replace(data, progress=report), parts[k]))
            return sources

        every, local = list(range(len(parts))), [kind for kind in kinds if kind.local]
        jobs = [(kind, every[-1:]) for kind in local] + [(kind, every) for kind in kinds if not kind.local]
        jobs += [(kind, [k]) for k in every[:-1] for kind in local]
        fitted: dict[tuple[type[PoseSource], int], PoseSource | None] = {}
        for (kind, numbers), sources in zip(jobs, in_threads(fit, jobs), strict=True):
            fitted.update({(kind, k): source for k, source in zip(numbers, sources, strict=True)})
        return [
            cls(
                tuple(source for kind in kinds if (source := fitted[kind, k]) is not None),
                data.bins_of(frames),
                data.sign_reference,
            )
            for k, frames in enumerate(parts)
        ]

    @property
    def frames(self) -> IntArray:
        """Frames of the training data that at least one source has learnt from, increasing."""
        return np.unique(np.concatenate([source.frames for source in self.sources]))

    @property
    def local(self) -> bool:
        """Whether a source uses local features."""
        return any(source.local for source in self.sources)

    @cached_property
    def cells(self) -> QuantileBins:
        """Cells of the beliefs' marginals."""
        return belief_cells(self.bins)

    def find(self, kind: type[Source]) -> Source | None:
        """The source of a class, or None."""
        return next((source for source in self.sources if isinstance(source, kind)), None)

    def beliefs(self, evidence: FrameEvidence) -> Beliefs:
        """Beliefs about the poses of n images."""
        answers = [source.answer(evidence) for source in self.sources]
        proba, mixtures, estimates = self._density(answers, len(evidence)), [], []
        measured = [answer.measurements for answer in answers if answer.measurements]
        local = [a.measurements for a, s in zip(answers, self.sources, strict=True) if s.local and a.measurements]
        for i, modes in enumerate(mode_candidates(proba, self.bins)):
            mixtures.append(fuse(modes, [measurements[i] for measurements in measured]))
            estimates.append([estimate for measurements in local for estimate in measurements[i]])
        return Beliefs(proba, mixtures, estimates)

    def marginals(self, beliefs: Beliefs) -> list[FloatArray]:
        """Seven arrays (n, cells), see :meth:`Beliefs.marginals`."""
        return beliefs.marginals(self.bins, self.cells, self.sign_reference)

    def supports(self, beliefs: Beliefs) -> list[Support]:
        """What supports the cuboids of each image's region: its hypotheses as cells."""
        return [Support.of(m.candidates, self.cells, self.sign_reference) for m in beliefs.mixtures]

    def marginals_by_part(self, beliefs: Beliefs) -> Iterator[tuple[slice, list[FloatArray]]]:
        """The marginals in chunks of images, with the rows of each chunk: all at once would take much memory."""
        for start in range(0, max(len(beliefs), 1), _IMAGES_AT_A_TIME):
            rows = slice(start, start + _IMAGES_AT_A_TIME)
            yield rows, self.marginals(beliefs.part(rows))

    def _density(self, answers: Sequence[SourceAnswer], n: int) -> list[RealArray]:
        """The mean of the sources' softmaxes; the distribution of the training frames where no source has one."""
        blocks = [answer.proba for answer in answers if answer.proba is not None]
        if not blocks:
            return [np.full((n, k), 1 / k) for k in self.bins.sizes]
        return blocks[0] if len(blocks) == 1 else [np.mean(columns, axis=0) for columns in zip(*blocks, strict=True)]
