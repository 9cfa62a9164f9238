"""Principal components of features: distances and slopes of the local regression are taken in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.vision import feature_scaling

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """A linear map of features, learnt without targets.

    Attributes
    ----------
    offset
        (F,) mean of the features that it was fitted to.
    directions
        (F, k) directions of largest variance with their scale in them, the largest first.
    """

    offset: FloatArray
    directions: FloatArray

    def apply(self, features: FloatArray) -> FloatArray:
        """Components (n, k) of features (n, F)."""
        return np.asarray((features - self.offset) @ self.directions, dtype=np.float32)

    def leading(self, k: int) -> PrincipalComponents:
        """The first k components alone."""
        return PrincipalComponents(self.offset, np.ascontiguousarray(self.directions[:, :k]))


def fit_components(features: FloatArray, n_components: int, view: slice) -> PrincipalComponents | None:
    """Principal components of standardised features, all on one scale: their mean variance is one.

    The components are not whitened, so that distances count each by its variance.

    Parameters
    ----------
    features
        (n, F).
    n_components
        Number of directions; n - 1 and the number of features in the view limit it.
    view
        Features that are looked at; the others count nothing.

    Returns
    -------
    PrincipalComponents or None
        None where features in the view are all the same.
    """
    if not np.ptp(features[:, view], axis=0).any():  # the rounded mean of equal numbers may differ from them
        return None
    offset, scale = feature_scaling(features)
    standard = (features[:, view] - offset[view]) / scale[view]
    from sklearn.decomposition import PCA  # noqa: PLC0415 - seconds to import; running a model fits none

    n, n_features = standard.shape
    # exact solvers: the last of a few hundred directions are where a randomised one is poor
    solver = "full" if n <= n_features else "covariance_eigh"
    pca = PCA(min(n_components, n - 1, n_features), svd_solver=solver).fit(standard)
    gain = np.sqrt(max(float(pca.explained_variance_.mean()), 1e-12))
    directions = np.zeros((features.shape[1], len(pca.components_)), dtype=np.float32)
    directions[view] = (pca.components_ / gain).T / scale[view, None]
    return PrincipalComponents(offset, directions)
