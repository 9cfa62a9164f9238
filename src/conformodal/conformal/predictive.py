"""Predictive distributions over bins: densities, quantiles, modes, samples and probabilities of intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from sklearn.utils import check_random_state

from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .bins import QuantileBins
from .checks import Probabilities, as_probabilities, as_targets, check_number, column_names
from .regions import Regions


class PredictiveDensity:
    """The distribution of each of d targets of n samples, constant within every bin.

    It is what the learner believes, not calibrated: coverage is guaranteed for regions only.

    Parameters
    ----------
    bins
        The bins of the targets.
    proba
        Their probabilities, (n, d, K) or a list of d arrays (n, K_j).

    Examples
    --------
    >>> from conformodal.conformal import PredictiveDensity, QuantileBins
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 4]])
    >>> density = PredictiveDensity(bins, [[[0.5, 0.1, 0.4]]])
    >>> density.pdf([0.5]), density.cdf([3.0]), density.quantile(0.25), density.mode
    (array([[0.5]]), array([[0.8]]), array([[0.5]]), array([[0.5]]))
    """

    def __init__(self, bins: QuantileBins, proba: Probabilities) -> None:
        self.bins = bins
        self.proba: Sequence[FloatArray] = [part.astype(np.float64) for part in as_probabilities(proba, bins.sizes)]
        self._below = [np.zeros((len(part), part.shape[1] + 1)) for part in self.proba]
        for below, part in zip(self._below, self.proba, strict=True):
            np.cumsum(part, axis=1, out=below[:, 1:])

    def __len__(self) -> int:
        return len(self.proba[0])

    def pdf(self, y: npt.ArrayLike) -> FloatArray:
        """Density at one value per sample and target, `y` (n, d) or (n,); 0 outside the bins. (n, d)."""
        codes = self.bins.encode(self._values(y))
        rows = np.arange(len(self))
        parts = zip(self.proba, codes.T, self.bins.widths, strict=True)
        return np.stack([p[rows, code] / widths[code] * (code >= 0) for p, code, widths in parts], axis=1)

    def cdf(self, y: npt.ArrayLike) -> FloatArray:
        """Probability of values up to `y`, (n, d) or (n,), as (n, d)."""
        return np.stack([self._reached(j, column) for j, column in enumerate(self._values(y).T)], axis=1)

    def quantile(self, q: float) -> FloatArray:
        """The value that is not exceeded with probability `q`, (n, d)."""
        check_number(q, "q", Range(0, 1))
        return self._at(np.full((len(self), self.bins.n_targets), float(q)))

    @property
    def mean(self) -> FloatArray:
        """Mean, (n, d)."""
        return np.stack([p @ c for p, c in zip(self.proba, self.bins.centers, strict=True)], axis=1)

    @property
    def mode(self) -> FloatArray:
        """Middle of the bin of highest density, (n, d)."""
        parts = zip(self.proba, self.bins.widths, self.bins.centers, strict=True)
        return np.stack([centers[(p / widths).argmax(axis=1)] for p, widths, centers in parts], axis=1)

    def sample(self, size: int = 1, random_state: Any = None) -> FloatArray:
        """Independent draws for every sample and target, (size, n, d)."""
        random, shape = check_random_state(random_state), (len(self), self.bins.n_targets)
        return np.stack([self._at(random.random_sample(shape)) for _ in range(size)])

    def flat_probabilities(self, regions: Regions, target: int = 0) -> FloatArray:
        """Probability (m,) of each of the ``regions.flat_intervals(target)``."""
        if len(regions) != len(self) or regions.bins.sizes != self.bins.sizes:
            raise ConformodalError(f"regions must be of the same {len(self)} samples and bins, got {regions!r}")
        offsets, runs = regions.flat_runs(target)
        rows, below = np.repeat(np.arange(len(self)), np.diff(offsets)), self._below[target]
        return np.asarray(below[rows, runs[:, 1]] - below[rows, runs[:, 0]])

    def _values(self, y: npt.ArrayLike) -> FloatArray:
        column_names(y, "y", self.bins.names)
        values = as_targets(y, self.bins.n_targets)
        if len(values) != len(self):
            raise ConformodalError(f"y has {len(values)} rows, the densities have {len(self)}")
        return values

    def _reached(self, j: int, values: FloatArray) -> FloatArray:
        edges, rows = self.bins.edges_[j], np.arange(len(values))
        code = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
        share = np.clip((values - edges[code]) / np.diff(edges)[code], 0, 1)
        return np.asarray(self._below[j][rows, code] + share * self.proba[j][rows, code])

    def _at(self, levels: FloatArray) -> FloatArray:
        """Quantiles at a level for every sample and target, (n, d)."""
        quantiles, rows = np.empty_like(levels), np.arange(len(levels))
        for j, (level, edges) in enumerate(zip(levels.T, self.bins.edges_, strict=True)):
            code = np.minimum((self._below[j][:, 1:] < level[:, None]).sum(axis=1), edges.size - 2)
            mass = self.proba[j][rows, code]
            share = np.divide(level - self._below[j][rows, code], mass, out=np.zeros(len(rows)), where=mass > 0)
            quantiles[:, j] = edges[code] + np.clip(share, 0, 1) * np.diff(edges)[code]
        return quantiles
