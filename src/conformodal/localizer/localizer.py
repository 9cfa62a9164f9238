"""Pose sources that learnt from the same frames, and their joint belief about an image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeVar

import numpy as np

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import FloatArray, IntArray, RealArray
from conformodal.core.parallel import go_on, in_threads
from conformodal.localizer.sources.registry import PoseSource, SourceAnswer, find_source
from conformodal.localizer.sources.source_data import SourceData

from .belief import Beliefs, belief_cells
from .candidates import mode_candidates
from .errors import LocalizationError
from .evidence import FrameEvidence
from .fusion import fuse
from .regions import Support

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
    def fit(cls, data: SourceData, frames: IntArray, names: Sequence[str], fitted: Sequence[PoseSource] = ()) -> Self:
        """Fit the named sources on `frames` (m,) alone, see :meth:`fit_each`."""
        return cls.fit_each(data, [frames], names, fitted)[0]

    @classmethod
    def fit_each(
        cls, data: SourceData, parts: Sequence[IntArray], names: Sequence[str], fitted: Sequence[PoseSource] = ()
    ) -> list[Self]:
        """A localizer for each part (m,) of the frames, which learns from it alone.

        A source that cannot be fitted is left out. One among `fitted` that learnt from exactly these frames is reused:
        the caller knows that fitting it again would give the same. Sources learn in threads. One that uses local
        features, which takes longest, learns several parts at once, the last part (by default all frames, whose matches
        the others share) before; others learn part after part: networks share random numbers.
        """

        def told(stage: str, done: int, total: int) -> None:
            go_on()
            if data.progress is not None:
                data.progress(stage, done, total)

        def fit(job: tuple[str, list[int]]) -> list[PoseSource | None]:
            name, which = job
            found = []
            for frames in (parts[k] for k in which):
                go_on()
                same = [s for s in fitted if s.name == name and np.array_equal(s.frames, frames)]
                found.append(same[-1] if same else find_source(name).fit(replace(data, progress=told), frames))
            return found

        each, local = list(range(len(parts))), [name for name in names if find_source(name).local]
        jobs = [(name, each[-1:]) for name in local] + [(name, each) for name in names if name not in local]
        jobs += [(name, [k]) for k in each[:-1] for name in local]
        found = {}
        for (name, which), its in zip(jobs, in_threads(fit, jobs), strict=True):
            found.update({(name, k): source for k, source in zip(which, its, strict=True)})
        return [
            cls(
                tuple(source for name in names if (source := found[name, k]) is not None),
                data.bins_of(frames),
                data.sign_reference,
            )
            for k, frames in enumerate(parts)
        ]

    @property
    def frames(self) -> IntArray:
        """Frames of the training data that at least one source has seen, increasing."""
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
        proba = self._density(answers, len(evidence))
        measured = [answer.measurements for answer in answers if answer.measurements]
        modes = mode_candidates(proba, self.bins)
        mixtures = [fuse(own, [its[i] for its in measured]) for i, own in enumerate(modes)]
        local = [a.measurements for a, s in zip(answers, self.sources, strict=True) if s.local and a.measurements]
        return Beliefs(proba, mixtures, [[one for its in local for one in its[i]] for i in range(len(evidence))])

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
        given = [answer.proba for answer in answers if answer.proba is not None]
        if not given:
            return [np.full((n, k), 1 / k) for k in self.bins.sizes]
        if len(given) == 1:
            return given[0]
        return [np.mean(blocks, axis=0) for blocks in zip(*given, strict=True)]
