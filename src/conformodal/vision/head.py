"""A trained head in NumPy: its predictions need no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.special import erf, softmax

from .errors import VisionError

_EPSILON = 1e-5  # of the layer norm, torch's default
_LEAST_SCALE = 1e-3  # features that hardly vary (dead ReLU6 outputs) must not blow up when they do


def feature_scaling(
    features: npt.NDArray[np.float32],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Mean and scale, (F,) each, that standardise the features (n, F) of the training part."""
    return features.mean(axis=0), features.std(axis=0) + np.float32(_LEAST_SCALE)


@dataclass(frozen=True, eq=False)
class SoftmaxHead:
    """Standardised features, one hidden layer with layer norm and GELU, and a softmax for every target.

    Attributes
    ----------
    weights
        Arrays under the names of :class:`~conformodal.networks.Head`.
    outputs
        Bins of each target, ``[K_1, ..., K_d]``.
    """

    untrained: ClassVar[tuple[str, ...]] = ("offset", "scale")

    weights: Mapping[str, npt.NDArray[np.float32]]
    outputs: Sequence[int]

    @property
    def hidden(self) -> int:
        """Units of the hidden layer."""
        return int(self.weights["output.weight"].shape[1])

    @property
    def n_features(self) -> int:
        """How many features the head sees, from the first on."""
        return int(self.weights["offset"].size)

    def standardise(self, features: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """What the hidden layer sees, (n, n_features), of features (n, F).

        Raises
        ------
        VisionError
            If there are fewer features than the head sees.
        """
        if features.shape[1] < self.n_features:
            raise VisionError(f"the head sees {self.n_features} features, got {features.shape[1]}")
        seen = features[:, : self.n_features]
        return np.asarray((seen - self.weights["offset"]) / self.weights["scale"], dtype=np.float32)

    def predict_proba(self, features: npt.NDArray[np.float32]) -> list[npt.NDArray[np.floating[Any]]]:
        """Softmax of every target: d arrays (n, K_j), float64 so that rows sum to one closely.

        Features (n, F) may go on after those that the head sees.
        """
        ours = self.weights
        x = self.standardise(features)
        x = x @ ours["trunk.1.weight"].T + ours["trunk.1.bias"]
        x = x - x.mean(axis=1, keepdims=True)
        x /= np.sqrt((x**2).mean(axis=1, keepdims=True) + np.float32(_EPSILON))
        x = x * ours["trunk.2.weight"] + ours["trunk.2.bias"]
        x = x * np.float32(0.5) * (1 + erf(x * np.float32(np.sqrt(0.5))))
        raw = (x @ ours["output.weight"].T + ours["output.bias"]).astype(np.float64)
        cuts = np.cumsum(self.outputs)[:-1]
        return [softmax(block, axis=1) for block in np.split(raw, cuts, axis=1)]
