"""Principal components: from thousands of features to a few hundred."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import Float32Array


@dataclass(frozen=True, eq=False)
class Projection:
    """A linear map of features, learnt without targets.

    `offset` (F,) is the mean of the training features. `components` are (F, k) scaled directions, or (F,) scales that
    keep every feature.
    """

    offset: Float32Array
    components: Float32Array

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

    They are not whitened, so that a network and dropout see how much each matters. What they are worth beside all
    features: benchmarks/ablation.py. At most n - 1 and F are computed; None keeps all features. Those that are not in
    the `view` get weight zero.
    """
    offset = features.mean(axis=0)
    if view != slice(None):
        part = fit_projection(features[:, view], n_components)
        shape = (features.shape[1], *part.components.shape[1:])
        components = np.zeros(shape, dtype=np.float32)
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
