"""The pose source that is a trained network head: a softmax over bins per target (the paper, section 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.extras import require_extra
from conformodal.core.progress import stage_of
from conformodal.features.head import SoftmaxHead
from conformodal.localizer.evidence import FrameEvidence

from .registry import SourceAnswer, SourceData, SourceState, register_source


@register_source
@dataclass(frozen=True, eq=False)
class HeadSource:
    """A trained head with a softmax per target, and the frames (m,) that it was trained on."""

    name: ClassVar[str] = "head"
    local: ClassVar[bool] = False

    head: SoftmaxHead
    frames: IntArray

    @classmethod
    def fit(cls, data: SourceData, frames: IntArray) -> Self:
        """Train on order-aware labels, or one-hot ones where ``sigma_bins`` is 0."""
        with require_extra("train", "training"):
            from conformodal.features.heads import fit_head, soft_cross_entropy  # noqa: PLC0415

        bins = data.bins_of(frames)
        head = fit_head(
            data.features[frames],
            np.concatenate(bins.soft_targets(data.targets[frames], data.sigma_bins), axis=1),
            bins.sizes,
            soft_cross_entropy,
            data.training,
            projection=data.projection(frames, data.training.components),
            progress=stage_of(data.progress, "training"),
        )
        return cls(head.trained(), frames)

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """Probabilities of all bins."""
        return SourceAnswer(proba=self.head.predict_proba(evidence.features))

    def state(self) -> SourceState:
        """The head's weights and shape."""
        settings = {"hidden": self.head.hidden, "outputs": list(self.head.outputs)}
        return SourceState({"frames": self.frames, **self.head.weights}, settings)

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The stored source."""
        weights = {k: v for k, v in state.arrays.items() if k != "frames"}
        return cls(SoftmaxHead(weights, state.settings["outputs"]), state.arrays["frames"])
