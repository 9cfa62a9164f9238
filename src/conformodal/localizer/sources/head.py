"""The pose source that is a trained network head: a softmax over bins per target (the paper, section 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.progress import stage_of
from conformodal.core.schema import ArraySpec
from conformodal.features.head import Head, fit_head, soft_cross_entropy
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.training_data import TrainingData

from .registry import SourceAnswer, SourceState, register_source

_ARRAYS = {
    "offset": ArraySpec("f", ("n_features",)),
    "components": ArraySpec("ef", ("n_features", "k")),
    "hidden.weight": ArraySpec("f", ("hidden", "k")),
    "hidden.bias": ArraySpec("f", ("hidden",)),
    "norm.weight": ArraySpec("f", ("hidden",)),
    "norm.bias": ArraySpec("f", ("hidden",)),
    "output.weight": ArraySpec("f", ("n_bins", "hidden")),
    "output.bias": ArraySpec("f", ("n_bins",)),
}
_SCALES, _OF_SCALES = ArraySpec("ef", ("n_features",)), ArraySpec("f", ("hidden", "n_features"))


@register_source
@dataclass(frozen=True, eq=False)
class HeadSource:
    """A trained head with a softmax per target, and the frames (m,) that it was trained on."""

    name: ClassVar[str] = "head"
    local: ClassVar[bool] = False
    least_sigma_m: ClassVar[float] = math.inf  # its modes refine no estimate

    head: Head
    frames: IntArray

    @classmethod
    def fit(cls, data: TrainingData, frames: IntArray) -> Self:
        """Train on order-aware labels, or one-hot ones where ``sigma_bins`` is 0."""
        bins = data.bins_of(frames)
        head = fit_head(
            data.features[frames],
            np.concatenate(bins.soft_targets(data.targets[frames], data.settings.sigma_bins), axis=1),
            bins.sizes,
            soft_cross_entropy,
            data.settings.training,
            projection=data.projection(frames, data.settings.training.components),
            progress=stage_of(data.progress, "training"),
        )
        return cls(head, frames)

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """Probabilities of all bins."""
        return SourceAnswer(proba=self.head.predict_proba(evidence.features))

    def state(self) -> SourceState:
        """The head's weights."""
        return SourceState({"frames": self.frames, **self.head.weights, **self.head.projection.arrays()})

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The stored source."""
        scaled = state.arrays["components"].ndim == 1  # without principal components
        state.check(_ARRAYS | ({"components": _SCALES, "hidden.weight": _OF_SCALES} if scaled else {}), {})
        weights = {k: v.astype(np.float32, copy=False) for k, v in state.arrays.items() if k != "frames"}
        return cls(Head(weights, state.bins), state.arrays["frames"])
