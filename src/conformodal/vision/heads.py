"""The small trained part: a shared trunk and one output block a target."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn


class Head(nn.Module):
    """Standardised features, dropout, one hidden layer, and a linear output for every target.

    The conformal network has one softmax of K bins a target; the classical regressor has one number a target and
    shares all else.

    Parameters
    ----------
    n_features
        Length of the feature vector.
    outputs
        Outputs of each target: ``[K_1, ..., K_d]``, or ones.
    hidden
        Units of the hidden layer.
    dropout
        Share of features, and of hidden units, dropped in training.
    """

    feature_mean: torch.Tensor
    feature_scale: torch.Tensor

    def __init__(self, n_features: int, outputs: list[int], hidden: int = 256, dropout: float = 0.3) -> None:
        super().__init__()
        self.outputs = list(outputs)
        self.register_buffer("feature_mean", torch.zeros(n_features))
        self.register_buffer("feature_scale", torch.ones(n_features))
        self.trunk = nn.Sequential(
            nn.Dropout(dropout), nn.Linear(n_features, hidden), nn.LayerNorm(hidden), nn.GELU(), nn.Dropout(dropout)
        )
        self.output = nn.Linear(hidden, sum(outputs))

    def standardise_by(self, features: torch.Tensor) -> None:
        """Take mean and scale of the inputs from training features (n, F)."""
        self.feature_mean.copy_(features.mean(dim=0))
        # features that hardly vary (dead ReLU6 outputs) must not blow up when they do
        self.feature_scale.copy_(features.std(dim=0, correction=0) + 1e-3)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Raw outputs (n, sum of outputs) of features (n, F)."""
        x = (features - self.feature_mean) / self.feature_scale
        result: torch.Tensor = self.output(self.trunk(x))
        return result

    def split(self, raw: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """One (n, K_j) block a target."""
        return torch.split(raw, self.outputs, dim=1)


def predict_proba(head: Head, features: npt.NDArray[np.float32]) -> list[npt.NDArray[np.floating[Any]]]:
    """Softmax of every target: d arrays (n, K_j), float64 so that rows sum to one closely."""
    with torch.inference_mode():
        blocks = head.split(head(torch.from_numpy(features)))
        return [torch.softmax(block.double(), dim=1).numpy() for block in blocks]


def predict_values(head: Head, features: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Raw outputs (n, d): the classical regressor's answers, on the standardised scale."""
    with torch.inference_mode():
        return np.asarray(head(torch.from_numpy(features)).double().numpy())
