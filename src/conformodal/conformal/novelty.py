"""A conformal test of novelty: whether a new sample is like the reference samples."""

from __future__ import annotations

from copy import copy
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, FloatArray

from .checks import as_array, as_doubles, as_finite, as_scores
from .errors import ConformalError
from .grouping import as_groups, factorise

_ROWS = 256
_LARGEST_SQUARE = 1e300


class NoveltyTest:
    """Conformal p-values of "this sample comes from the distribution of the reference samples".

    The novelty score of a sample is its distance to the nearest reference sample of another group. If the groups and
    the group of a new sample are exchangeable, and the new sample is drawn at random from its group, then
    ``P(p <= u) <= u`` for every u, and no data are held out. The full conformal test (Vovk, Gammerman and Shafer 2005;
    for groups Dunn, Wasserman and Ramdas 2023) adds the new group to the references, which can only reduce the
    distances of reference samples. So this p-value is never smaller than that of the full test.

    Parameters
    ----------
    references
        (n, k) reference samples, as descriptors that were not learnt from them.
    groups
        (n,) labels of dependent samples, such as neighbouring frames of a video.

    Attributes
    ----------
    scores_ : (n,) scores of the reference samples
    weights_ : (n,) one over the size of each sample's group
    n_groups : number of groups, K; no p-value is smaller than ``1 / (K + 1)``

    Examples
    --------
    >>> import numpy as np
    >>> test = NoveltyTest(np.arange(9.0)[:, None], np.arange(9))
    >>> test.p_values(test.scores(np.array([[4.5], [20.0]])))
    array([1. , 0.1])
    """

    def __init__(self, references: npt.ArrayLike, groups: npt.ArrayLike) -> None:
        self._double = as_finite(references, "references", "(n, k)")
        if self._double.size == 0:
            raise ConformalError(f"references must be finite, of shape (n, k), got shape {self._double.shape}")
        own = as_groups(groups, len(self._double))
        group = factorise(own)[1]
        if not group.any():
            raise ConformalError("a novelty test needs two groups of reference samples or more, got 1")
        given = as_array(references, "references")  # float16 stays: it takes a quarter of the room
        self.references = given.astype(given.dtype.newbyteorder("=")) if given.dtype.char in "efd" else self._double
        self._square = _squares(self._double, "references")
        self._labels = own
        self._rank(self._nearest(self._double, group, group), own)

    def rescored(self, scores: npt.ArrayLike, groups: npt.ArrayLike) -> Self:
        """The test with other scores (m,) of known samples, in groups (m,), to rank new scores of their kind among.

        The samples need not be the references; exact where neither they nor the new one had a part in the score.
        """
        other, own = copy(self), as_scores(scores)
        other._rank(np.asarray(own, dtype=np.float64), as_groups(groups, len(own)))
        return other

    def _rank(self, scores: FloatArray, groups: AnyArray) -> None:
        self.scores_, self.groups = scores, groups
        group = factorise(groups)[1]
        sizes = np.bincount(group)
        self.n_groups = len(sizes)
        self.weights_: FloatArray = 1 / sizes[group]
        order = np.argsort(self.scores_, kind="stable")
        self._sorted = self.scores_[order]
        # weight of all reference samples from a rank on: what scores at least as much
        self._from = np.concatenate((np.cumsum(self.weights_[order][::-1])[::-1], [0.0]))

    def scores(self, samples: npt.ArrayLike, left_out: npt.ArrayLike | None = None) -> FloatArray:
        """Novelty scores (m,) of samples (m, k); references of a sample's group in `left_out` (m,) do not count."""
        new = as_doubles(samples, "samples")
        if new.ndim != 2 or new.shape[1] != self.references.shape[1]:
            raise ConformalError(f"samples must have shape (m, {self.references.shape[1]}), got {new.shape}")
        new = as_finite(new, "samples", "(m, k)")
        if left_out is None:
            return self._nearest(new)
        _, codes = factorise(np.concatenate((self._labels, as_groups(left_out, len(new)))))
        return self._nearest(new, codes[len(self._labels) :], codes[: len(self._labels)])

    def p_values(self, scores: npt.ArrayLike) -> FloatArray:
        """``(1 + sum over groups of the share of their scores that are at least as large) / (K + 1)``, (m,)."""
        at_least = self._from[np.searchsorted(self._sorted, as_scores(scores), side="left")]
        return np.asarray((1 + at_least) / (self.n_groups + 1))

    def left_out_p_values(self) -> FloatArray:
        """P-values (n,) of the known samples among the other groups, in the unit of :meth:`p_values`.

        Those of at most u are the same samples whichever new sample, with a larger p-value, joins them.
        """
        own = np.empty(len(self.scores_))
        _, group = factorise(self.groups)
        for code in range(self.n_groups):
            mine = np.flatnonzero(group == code)
            ranked = np.sort(self.scores_[mine])
            own[mine] = 1 - np.searchsorted(ranked, self.scores_[mine], side="left") / len(mine)
        at_least = self._from[np.searchsorted(self._sorted, self.scores_, side="left")]
        return np.asarray((1 + at_least - own) / (self.n_groups + 1))

    @property
    def least_p(self) -> float:
        """The smallest possible p-value."""
        return 1 / (self.n_groups + 1)

    def _nearest(
        self, samples: FloatArray, group: AnyArray | None = None, others: AnyArray | None = None
    ) -> FloatArray:
        found = np.empty(len(samples))
        for start in range(0, len(samples), _ROWS):
            rows = slice(start, start + _ROWS)
            square = _squares(samples[rows], "samples")[:, None] + self._square - 2 * samples[rows] @ self._double.T
            if group is not None:
                square[group[rows, None] == others] = np.inf
            # from the difference itself: cancellation in the products would make equal samples differ
            apart = samples[rows] - self._double[square.argmin(axis=1)]
            found[rows] = np.sqrt((apart**2).sum(axis=1))
        return found


def _squares(samples: FloatArray, name: str) -> FloatArray:
    with np.errstate(over="ignore"):
        squares = (samples**2).sum(axis=1)
    if not (squares < _LARGEST_SQUARE).all():
        raise ConformalError(f"{name} must be so small that float64 holds their squared distances, below 1e150")
    return np.asarray(squares)
