"""A conformal test of novelty: whether a new sample is like those that are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .checks import as_groups
from .errors import ConformalError

FloatArray = npt.NDArray[np.float64]
_ROWS = 256


class NoveltyTest:
    """Conformal p-values for "this sample comes from where the reference samples come from".

    The novelty score of a sample is its distance to the nearest reference sample. A reference sample is scored without
    the samples of its own group. If the groups and the group of a new sample are exchangeable, and the new sample is
    drawn at random from its group, then ``P(p <= u) <= u`` for every u. No data are held out for this. The full
    conformal test (Vovk, Gammerman and Shafer 2005; for groups Dunn, Wasserman and Ramdas 2023) would add the new group
    to the references. The distances of reference samples could then only become smaller; that of the new sample would
    not change. So this p-value is never smaller than that of the full test.

    Parameters
    ----------
    references
        (n, k) reference samples, as descriptors that were not learnt from them.
    groups
        (n,) labels: samples of one group, such as neighbouring frames of a video, are new together.

    Attributes
    ----------
    scores_ : (n,) scores of the reference samples
    weights_ : (n,) one over the size of each sample's group
    n_groups : number of groups, K; no p-value is smaller than ``1 / (K + 1)``

    Raises
    ------
    ConformalError
        If shapes do not fit, values are not finite, or there are fewer than two groups.

    Examples
    --------
    >>> import numpy as np
    >>> test = NoveltyTest(np.arange(9.0)[:, None], np.arange(9))
    >>> test.p_values(test.scores(np.array([[4.5], [20.0]])))
    array([1. , 0.1])
    """

    def __init__(self, references: npt.ArrayLike, groups: npt.ArrayLike) -> None:
        known = np.asarray(references)
        if known.ndim != 2 or known.size == 0 or not np.isfinite(known).all():
            raise ConformalError(f"references must be finite, of shape (n, k), got shape {known.shape}")
        self.groups = as_groups(groups, len(known))
        _, group, sizes = np.unique(self.groups, return_inverse=True, return_counts=True)
        if len(sizes) < 2:
            raise ConformalError(f"a novelty test needs two groups of reference samples or more, got {len(sizes)}")
        self.references = known
        self.n_groups = len(sizes)
        self.weights_: FloatArray = 1 / sizes[group]
        self._double = known.astype(np.float64)
        self._square = (self._double**2).sum(axis=1)
        self.scores_ = self._nearest(self._double, group)
        order = np.argsort(self.scores_, kind="stable")
        self._sorted = self.scores_[order]
        # weight of all reference samples from a rank on: what scores at least as much
        self._from = np.concatenate((np.cumsum(self.weights_[order][::-1])[::-1], [0.0]))

    def scores(self, samples: npt.ArrayLike) -> FloatArray:
        """Novelty scores (m,) of samples (m, k)."""
        new = np.asarray(samples, dtype=np.float64)
        if new.ndim != 2 or new.shape[1] != self.references.shape[1]:
            raise ConformalError(f"samples must have shape (m, {self.references.shape[1]}), got {new.shape}")
        return self._nearest(new)

    def p_values(self, scores: npt.ArrayLike) -> FloatArray:
        """``(1 + sum over groups of the share of their scores that are at least as large) / (K + 1)``, (m,)."""
        at_least = self._from[np.searchsorted(self._sorted, np.asarray(scores), side="left")]
        return np.asarray((1 + at_least) / (self.n_groups + 1))

    def left_out_p_values(self) -> FloatArray:
        """P-values (n,) of the reference samples, each among the other groups alone."""
        own = np.empty(len(self.scores_))
        for label in np.unique(self.groups):
            mine = np.flatnonzero(self.groups == label)
            ranked = np.sort(self.scores_[mine])
            own[mine] = 1 - np.searchsorted(ranked, self.scores_[mine], side="left") / len(mine)
        at_least = self._from[np.searchsorted(self._sorted, self.scores_, side="left")]
        return np.asarray((1 + at_least - own) / self.n_groups)

    @property
    def least_p(self) -> float:
        """The smallest p-value that so many groups can give."""
        return 1 / (self.n_groups + 1)

    def _nearest(self, samples: FloatArray, group: npt.NDArray[Any] | None = None) -> FloatArray:
        found = np.empty(len(samples))
        for start in range(0, len(samples), _ROWS):
            rows = slice(start, start + _ROWS)
            square = (samples[rows] ** 2).sum(axis=1)[:, None] + self._square - 2 * samples[rows] @ self._double.T
            if group is not None:
                square[group[rows, None] == group] = np.inf
            found[rows] = np.sqrt(np.maximum(square.min(axis=1), 0))
        return found
