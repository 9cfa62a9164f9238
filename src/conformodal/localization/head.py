"""A pose source that is one trained network: a softmax over bins for each target (the paper, section 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import torch

from conformodal.core import IntArray, stage_of
from conformodal.vision import Head, Projection, fit_head, predict_proba, soft_cross_entropy

from .evidence import FrameEvidence
from .source import SourceAnswer, SourceState, register_source
from .source_data import SourceData


@register_source
@dataclass(frozen=True, eq=False)
class HeadSource:
    """A head with a softmax for each target.

    Attributes
    ----------
    head
        Trained.
    frames
        (m,) frames that it was trained on.
    """

    name: ClassVar[str] = "head"
    local: ClassVar[bool] = False

    head: Head
    frames: IntArray

    @classmethod
    def fit(cls, data: SourceData, frames: IntArray) -> Self:
        """Train on order-aware labels, or one-hot ones where ``sigma_bins`` is 0."""
        bins = data.bins_of(frames)
        head = fit_head(
            data.features[frames],
            np.concatenate(bins.soft_targets(data.targets[frames], data.sigma_bins), axis=1),
            bins.sizes,
            soft_cross_entropy,
            data.training,
            projection=data.projection(frames, data.training.components),
            checkpoint_dir=data.checkpoint_dir,
            progress=stage_of(data.progress, "training"),
        )
        return cls(head, frames)

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """Probabilities of all bins."""
        return SourceAnswer(proba=predict_proba(self.head, evidence.features))

    def state(self) -> SourceState:
        """The network's weights and shape."""
        arrays = {"frames": self.frames, **{k: v.numpy() for k, v in self.head.state_dict().items()}}
        return SourceState(arrays, {"hidden": self.head.output.in_features, "outputs": self.head.outputs})

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored."""
        weights = {k: torch.from_numpy(v) for k, v in state.arrays.items() if k != "frames"}
        through = Projection(weights["offset"].numpy(), weights["components"].numpy())
        head = Head(through, state.settings["outputs"], state.settings["hidden"])
        head.load_state_dict(weights)
        return cls(head.eval(), state.arrays["frames"])
