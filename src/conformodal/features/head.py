"""A trained head in NumPy: its predictions need no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf, softmax

from conformodal.core.arrays import Float32Array, RealArray

from .projection import Projection

_EPSILON = 1e-5  # of the layer norm, torch's default


@dataclass(frozen=True, eq=False)
class SoftmaxHead:
    """Projected features, one hidden layer with layer norm and GELU, and a softmax per target.

    `weights` have the names of :class:`~conformodal.features.heads.Head`; `outputs` are the bins per target,
    ``[K_1, ..., K_d]``.
    """

    weights: Mapping[str, Float32Array]
    outputs: Sequence[int]

    @property
    def hidden(self) -> int:
        """Units of the hidden layer."""
        return int(self.weights["output.weight"].shape[1])

    @property
    def projection(self) -> Projection:
        """The projection of features that the head was trained behind."""
        return Projection(self.weights["offset"], self.weights["components"])

    def predict_proba(self, features: Float32Array) -> list[RealArray]:
        """Softmax of every target: d arrays (n, K_j), float64 so that rows sum to one closely."""
        ours = self.weights
        x = self.projection.apply(features)
        x = x @ ours["trunk.1.weight"].T + ours["trunk.1.bias"]
        x = x - x.mean(axis=1, keepdims=True)
        x /= np.sqrt((x**2).mean(axis=1, keepdims=True) + np.float32(_EPSILON))
        x = x * ours["trunk.2.weight"] + ours["trunk.2.bias"]
        x = x * np.float32(0.5) * (1 + erf(x * np.float32(np.sqrt(0.5))))
        raw = (x @ ours["output.weight"].T + ours["output.bias"]).astype(np.float64)
        cuts = np.cumsum(self.outputs)[:-1]
        return [softmax(block, axis=1) for block in np.split(raw, cuts, axis=1)]
