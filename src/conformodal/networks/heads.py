"""The small trained part: a shared trunk and one output block a target."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from conformodal.vision import Projection, SoftmaxHead, VisionError


class _Dropout(nn.Module):
    """As torch's, whose Bernoulli numbers are slow on a CPU: they took much of a small head's training."""

    def __init__(self, share: float) -> None:
        super().__init__()
        if not 0 <= share < 1:
            raise VisionError(f"dropout must be at least 0 and less than 1, got {share}")
        self.share = share

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if not self.training or self.share == 0:
            return x
        return x * torch.rand_like(x).ge_(self.share).mul_(1 / (1 - self.share))


class Head(nn.Module):
    """Projected features, dropout, one hidden layer, and a linear output for every target.

    The conformal network has one softmax of K bins a target; the classical regressor has one number a target and
    shares all else.

    Parameters
    ----------
    projection
        From features to what is learnt from; it stays as it is in training.
    outputs
        Outputs of each target: ``[K_1, ..., K_d]``, or ones.
    hidden
        Units of the hidden layer.
    dropout, input_dropout
        Share of hidden units, and of projected features, dropped in training.

    Raises
    ------
    VisionError
        If a share is not at least 0 and less than 1.
    """

    offset: torch.Tensor
    components: torch.Tensor

    def __init__(
        self,
        projection: Projection,
        outputs: list[int],
        hidden: int = 256,
        dropout: float = 0.3,
        input_dropout: float = 0.3,
    ) -> None:
        super().__init__()
        self.outputs = list(outputs)
        self.register_buffer("offset", torch.from_numpy(projection.offset))
        self.register_buffer("components", torch.from_numpy(projection.components))
        self.trunk = nn.Sequential(
            _Dropout(input_dropout),
            nn.Linear(projection.size, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            _Dropout(dropout),
        )
        self.output = nn.Linear(hidden, sum(outputs))

    @property
    def projection(self) -> Projection:
        """The projection that this head was made with."""
        return Projection(self.offset.numpy(), self.components.numpy())

    def project(self, features: torch.Tensor) -> torch.Tensor:
        """Projected features (n, k) of features (n, F)."""
        centred = features - self.offset
        return centred @ self.components if self.components.ndim == 2 else centred * self.components

    def answer(self, projected: torch.Tensor) -> torch.Tensor:
        """Raw outputs (n, sum of outputs) of projected features (n, k)."""
        result: torch.Tensor = self.output(self.trunk(projected))
        return result

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Raw outputs (n, sum of outputs) of features (n, F)."""
        return self.answer(self.project(features))

    def trained(self) -> SoftmaxHead:
        """The same head in NumPy, which predicts without torch."""
        weights = {name: value.detach().numpy().copy() for name, value in self.state_dict().items()}
        return SoftmaxHead(weights, self.outputs)

    def split(self, raw: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """One (n, K_j) block a target."""
        return torch.split(raw, self.outputs, dim=1)


# From a head, its raw outputs and the targets of a batch to one number.
Loss: TypeAlias = Callable[[Head, torch.Tensor, torch.Tensor], torch.Tensor]


def predict_values(head: Head, features: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Raw outputs (n, d): the classical regressor's standardised predictions."""
    with torch.inference_mode():
        return np.asarray(head(torch.from_numpy(features)).double().numpy())
