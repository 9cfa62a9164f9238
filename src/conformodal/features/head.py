"""A trained head and its projection of features in NumPy: its predictions need no torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf, softmax

from conformodal.core.arrays import Float32Array, RealArray

_EPSILON = 1e-5  # of the layer norm, torch's default


@dataclass(frozen=True, eq=False)
class Projection:
    """A linear map of features to their principal components, learnt without targets."""

    offset: Float32Array  # (F,) mean of the training features
    components: Float32Array  # (F, k) scaled directions, or (F,) scales that keep every feature

    @property
    def size(self) -> int:
        """How many components there are, k."""
        return int(self.components.shape[-1])

    def apply(self, features: Float32Array) -> Float32Array:
        """Projected features (n, k) of features (n, F)."""
        centred = features - self.offset
        projected = centred @ self.components if self.components.ndim == 2 else centred * self.components
        return np.asarray(projected, dtype=np.float32)


def fit_projection(features: Float32Array, n_components: int | None, view: slice = slice(None)) -> Projection:
    """Principal components of standardised features (n, F), scaled together to a mean variance of one.

    They are not whitened, so that a network and dropout see how much each matters. They make training faster.
    At most n - 1 and F are computed; None keeps all features. Those that are not in the `view` get weight zero.
    """
    offset = features.mean(axis=0)
    if view != slice(None):
        part = fit_projection(features[:, view], n_components)
        components = np.zeros((features.shape[1], *part.components.shape[1:]), dtype=np.float32)
        components[view] = part.components
        return Projection(offset, components)
    # features that hardly vary (dead ReLU6 outputs) must not blow up when they do
    scale = features.std(axis=0) + 1e-3
    n, n_features = features.shape
    # features that are all the same have no directions, even where their rounded mean differs from them
    if n_components is None or not np.ptp(features, axis=0).any():
        return Projection(offset, 1 / scale)
    from sklearn.decomposition import PCA  # noqa: PLC0415 - seconds to import; running a model fits none

    # exact solvers: the last of a few hundred directions are where a randomised one is poor
    solver = "full" if n <= n_features else "covariance_eigh"
    pca = PCA(min(n_components, n - 1, n_features), svd_solver=solver).fit((features - offset) / scale)
    gain = np.sqrt(max(float(pca.explained_variance_.mean()), 1e-12))
    components = np.ascontiguousarray((pca.components_ / gain).T / scale[:, None], dtype=np.float32)
    return Projection(offset, components)


@dataclass(frozen=True, eq=False)
class SoftmaxHead:
    """Projected features, one hidden layer with layer norm and GELU, and a softmax per target."""

    weights: Mapping[str, Float32Array]  # by their names in conformodal.features.heads.Head
    outputs: Sequence[int]  # bins per target

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
        weights = self.weights
        x = self.projection.apply(features)
        x = x @ weights["trunk.1.weight"].T + weights["trunk.1.bias"]
        x = x - x.mean(axis=1, keepdims=True)
        x /= np.sqrt((x**2).mean(axis=1, keepdims=True) + np.float32(_EPSILON))
        x = x * weights["trunk.2.weight"] + weights["trunk.2.bias"]
        x = x * np.float32(0.5) * (1 + erf(x * np.float32(np.sqrt(0.5))))
        raw = (x @ weights["output.weight"].T + weights["output.bias"]).astype(np.float64)
        cuts = np.cumsum(self.outputs)[:-1]
        return [softmax(block, axis=1) for block in np.split(raw, cuts, axis=1)]
