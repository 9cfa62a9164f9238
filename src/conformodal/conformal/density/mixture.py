"""A density over bins as a mixture of five smoothed distributions, weighted by held-out likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.linalg import svd
from scipy.special import ndtr
from sklearn.base import BaseEstimator
from sklearn.utils import gen_batches
from sklearn.utils.validation import _check_sample_weight

from conformodal.conformal.bins import QuantileBins, nearest_bins
from conformodal.conformal.checks import as_doubles, as_finite, not_calibrated
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.errors import ConformodalError

from .encoder import TableEncoder
from .forest import Groups, LeafForest, LeafProjection

# for each of the five components, in order: whether it is a distribution of scaled residuals
_RESIDUAL = (False, True, True, False, False)
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
_GRID_CELLS = 300
# least weight of a component, so that no density is exactly zero and far values differ
_MIN_WEIGHT = 1e-3
# rows at once of trees, and of arrays (rows, bins), which then stay in the processor's cache
_ROWS_AT_ONCE, _ROWS_IN_CACHE = 8192, 512
# of a kernel times its weight: what is left out changes no mass by a hundred-thousandth
_MIN_SINGULAR = 1e-4
_STEPS, _CELLS_PER_STEP = 4096, 8  # of a table of cells
# least density, relative to 1 / range, for logarithms
_FLOOR = 1e-6
_ITERATIONS = 200
# least spread of the values: distances in units of a smaller one may overflow
_MIN_SPREAD = 1e-150


def as_sample_weight(sample_weight: npt.ArrayLike, n: int) -> FloatArray:
    """Weights (n,) of samples, scaled so that the positive ones have mean one."""
    given = as_doubles(sample_weight, "sample_weight")
    try:
        given = _check_sample_weight(given if given.ndim else float(given), np.empty((n, 1)), ensure_non_negative=True)
    except ValueError as exc:
        raise ConformodalError(f"sample_weight: {exc}") from None
    if not given.any():  # which scikit-learn refuses from 1.9 on
        raise ConformodalError("sample_weight must be above zero for a sample at least, all are zero")
    relative = given / given.max()
    return np.asarray(relative / relative[relative > 0].mean())


class MixtureDensity(BaseEstimator):  # type: ignore[misc]
    """What the quick and the stacked density share: smoothing, mixing and prediction in blocks of rows.

    The components, in order: the marginal distribution of the values, that of the scaled residuals, and three whose
    weights a forest gives for each sample (one over scaled residuals, two over values). A fit sets the location, the
    model of the logarithmic spread, and the forests; the last of these knows the features alone.
    """

    location_: Any
    spread_: Any
    forests_: tuple[LeafForest, ...]

    def predict_proba(self, X: npt.ArrayLike) -> FloatArray:
        """Probabilities of the bins, (n, K)."""
        if not hasattr(self, "weights_"):
            raise not_calibrated(f"{type(self).__name__} is not fitted yet: call fit_bins(X, y, edges) first")
        features = self.encoder_.transform(X)
        parts = [self._proba(features[i : i + _ROWS_AT_ONCE]) for i in range(0, len(features), _ROWS_AT_ONCE)]
        return np.concatenate(parts) if parts else np.empty((0, self.edges_.size - 1))

    def _proba(self, features: FloatArray) -> FloatArray:
        *guided, direct = self.forests_
        order = direct.alike(features)
        features = features[order]  # neighbours then share leaves, which the processor's cache holds
        leaves = direct.apply(features)
        summary = self.location_.predict(features, direct.means(leaves))
        extended = np.column_stack((features, summary))
        spread = np.exp(self.spread_.predict(extended))
        leaves_of = [*(forest.apply(extended) for forest in guided), leaves]
        mixed = self._mixed_masses()
        total = np.empty((len(features), self.edges_.size - 1))
        for r in gen_batches(len(features), _ROWS_IN_CACHE):
            weights = np.hstack([of(those[r]) for of, those in zip(mixed.projections, leaves_of, strict=True)])
            of_residuals, of_values = np.split(weights, [len(mixed.residuals)], axis=1)
            # one shift of the residuals' mixture, whose rows then end at one, is all residuals need
            below = of_residuals @ mixed.residuals + mixed.residuals_of_all
            proba = shifted_masses(below, self._grid, summary[r, 0], spread[r], self._z_edges)
            proba *= mixed.residual_share
            proba += of_values.reshape(len(proba), -1, len(mixed.values)).sum(axis=1) @ mixed.values
            proba += mixed.values_of_all
            np.maximum(proba, 0, out=proba)  # the factors may be a little below
            total[order[r]] = proba / proba.sum(axis=1, keepdims=True)
        return total

    def _mixed_masses(self) -> _MixedMasses:
        """What forests' leaves say about masses; computed once, and not part of a file."""
        if "_mixed" not in vars(self):
            self._mixed = _MixedMasses.of(self.forests_, self.weights_, self._pooled, self._kernels)
        return self._mixed

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_mixed"}

    def _standardise(
        self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Features (n, p), standardised values (n,) and weights (n,), without rows of weight zero."""
        self.encoder_ = TableEncoder().fit(X)
        features, values = self.encoder_.transform(X), as_finite(y, "y", "(n,)")
        if values.size != len(features):
            raise ConformodalError(f"y must have one value per row of X ({len(features)}), got {values.size}")
        weight = np.ones(values.size) if sample_weight is None else as_sample_weight(sample_weight, values.size)
        kept = weight > 0
        if not kept.all():
            features, values, weight = features[kept], values[kept], weight[kept]
        if values.size < 2:
            raise ConformodalError(f"X must have at least 2 rows to learn a density, got n_samples={values.size}")
        (self.edges_,) = QuantileBins.from_edges([edges]).edges_
        with np.errstate(over="ignore", invalid="ignore"):
            center, scale = float(values.mean()), float(values.std()) or 1.0
        if not (np.isfinite([center, scale]).all() and scale >= _MIN_SPREAD):
            raise ConformodalError(f"y has a spread that float64 cannot work with, {scale:g} around {center:g}")
        self._z_edges = (self.edges_ - center) / scale
        return features, (values - center) / scale, weight

    def _mix(
        self,
        z: FloatArray,
        weight: FloatArray,
        place: tuple[FloatArray, FloatArray],
        groups: tuple[Groups, Groups],
        by_forest: list[FloatArray],
        validation: IntArray,
    ) -> None:
        """Choose every component's bandwidth, then the weights, by the likelihood of the `validation` rows (m,).

        `place` are location and spread (n,), out of fold; `groups` are of the values and of the scaled residuals;
        `by_forest` are out-of-bag weights (m, G). No row lends a kernel to itself: with its own, too narrow ones would
        seem likely.
        """
        loc, spread = place
        scaled = (z - loc) / spread
        self._grid = _grid_of(scaled)
        self._pooled = [np.bincount(of, weight)[None] / weight.sum() for of, _ in groups]
        others = [_without_own(of, weight, validation) for of, _ in groups]
        codes, widths, weight = nearest_bins(z[validation], self._z_edges), np.diff(self._z_edges), weight[validation]
        self._kernels: list[FloatArray] = []
        likelihoods, left_out = [], []
        for residual, weights in zip(_RESIDUAL, [*others, *by_forest], strict=True):
            centers, sample, edges = (
                (groups[1][1], scaled, self._grid) if residual else (groups[0][1], z, self._z_edges)
            )
            fits = []
            for factor in _FACTORS:
                kernel = kernel_masses(centers, sample, edges, factor)
                masses = weights @ kernel
                proba = self._shifted(masses, loc[validation], spread[validation]) if residual else masses
                each = log_density(proba, codes, widths)
                fits.append((float(np.average(each, weights=weight)), kernel, each, proba))
            _, kernel, each, proba = max(fits, key=lambda fit: fit[0])
            self._kernels.append(kernel)
            likelihoods.append(each)
            left_out.append(proba)
        mixed = np.maximum(mixture_weights(np.column_stack(likelihoods), weight), _MIN_WEIGHT)
        self.weights_ = mixed / mixed.sum()
        total = sum(share * proba for share, proba in zip(self.weights_, left_out, strict=True))
        self.left_out_ = np.asarray(total / np.sum(total, axis=1, keepdims=True)), codes

    def _shifted(self, masses: FloatArray, loc: FloatArray, spread: FloatArray) -> FloatArray:
        """Bin probabilities of values, from masses (n, M) of their scaled residuals."""
        below = np.pad(np.cumsum(masses, axis=1), ((0, 0), (1, 0)))
        rows = gen_batches(loc.size, _ROWS_IN_CACHE)
        return np.concatenate([shifted_masses(below[r], self._grid, loc[r], spread[r], self._z_edges) for r in rows])


@dataclass(frozen=True)
class _MixedMasses:
    """The mixture's masses as linear functions of what is kept for each leaf, with the weights of the mixture.

    A kernel over G groups and M cells is smooth, so that a product of (G, r) and (r, M) with a small r equals it.
    """

    projections: list[LeafProjection]  # of each forest: its part of residuals, if it has one, then of values
    residuals: FloatArray  # (r, M + 1) masses of scaled residuals below the grid's points, relative to all of residuals
    residuals_of_all: FloatArray  # (M + 1,) of the component that is the same for all samples
    values: FloatArray  # (r', K) masses of values over the bins, which forests share
    values_of_all: FloatArray  # (K,)
    residual_share: float  # weight of the components of residuals

    @classmethod
    def of(
        cls, forests: tuple[LeafForest, ...], weights: FloatArray, pooled: list[FloatArray], kernels: list[FloatArray]
    ) -> Self:
        """Of kernels of which the first two are no forest's, and the third, a forest's first, is of residuals."""
        shares = [share * kernel for share, kernel in zip(weights, kernels, strict=True)]
        residual_share = float(np.sum(weights[[*_RESIDUAL]]))
        values_of_all, residuals_of_all = ((w @ k)[0] for w, k in zip(pooled, shares[:2], strict=True))
        of_residuals, residuals = _factors(shares[2])
        of_values, values = _factors(np.vstack(shares[3:]))
        rest, projections = [of_residuals, *np.split(of_values, np.cumsum([len(k) for k in shares[3:-1]]))], []
        for forest in forests:
            projections.append(forest.projection([rest.pop(0) for _ in range(forest.n_groupings)]))
        below = [np.pad(np.cumsum(part, axis=-1), ((0, 0), (1, 0))) for part in (residuals, residuals_of_all[None])]
        return cls(
            projections, below[0] / residual_share, below[1][0] / residual_share, values, values_of_all, residual_share
        )


def _factors(kernel: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices (G, r) and (r, M) whose product is a kernel (G, M), by its singular values that are not tiny."""
    left, values, right = svd(kernel, full_matrices=False)
    large = values > _MIN_SINGULAR
    return left[:, large] * values[large], right[large]


def _without_own(groups: IntArray, weight: FloatArray, rows: IntArray) -> FloatArray:
    """Weights (m, G) of the groups of values (n,) for some rows, as if each of these were not there."""
    each: FloatArray = np.tile(np.bincount(groups, weight), (rows.size, 1))
    each[np.arange(rows.size), groups[rows]] -= weight[rows]
    total = weight.sum() - weight[rows]
    return np.asarray(np.maximum(each, 0) / total[:, None])


def log_spread(residual: FloatArray) -> FloatArray:
    """Logarithms (n,) of absolute residuals, each raised by a tenth of their median: none is of zero."""
    absolute = np.abs(residual)
    return np.log(absolute + (float(0.1 * np.median(absolute)) or 1e-6))


def _grid_of(scaled: FloatArray) -> FloatArray:
    """Cells with equal numbers of scaled residuals, and one beyond them at either end."""
    reach = (scaled.max() - scaled.min()) or 1.0
    ends = np.quantile(scaled, np.linspace(0, 1, _GRID_CELLS + 1))
    return np.unique(np.concatenate(([ends[0] - reach / 2], ends, [ends[-1] + reach / 2])))


def bandwidths(centers: FloatArray, values: FloatArray, factor: float) -> FloatArray:
    """Gaussian bandwidth at each of `centers`: Silverman's rule on `values`, narrower where they are dense.

    Source: Silverman (1986), 3.31; Abramson (1982). `factor` multiplies all.
    """
    quartiles = np.quantile(values, [0.25, 0.75])
    spread = min(values.std(), float(np.diff(quartiles)[0]) / 1.34) or values.std()
    pilot = max(0.9 * spread * values.size**-0.2, 1e-9 * (np.ptp(values) or 1.0))
    # the empirical distribution at 512 points stands for all values
    points = np.quantile(values, (np.arange(512) + 0.5) / 512)
    density = np.exp(-0.5 * ((centers[:, None] - points) / pilot) ** 2).mean(axis=1) + 1e-9
    local = np.sqrt(np.exp(np.log(density).mean()) / density)
    return np.asarray(factor * pilot * np.clip(local, 0.2, 5))


def kernel_masses(centers: FloatArray, values: FloatArray, edges: FloatArray, factor: float) -> FloatArray:
    """Mass that a kernel at each of `centers` puts in each bin, (G, K); the outer bins get what lies beyond."""
    below = ndtr((edges - centers[:, None]) / bandwidths(centers, values, factor)[:, None])
    below[:, 0], below[:, -1] = 0, 1
    return np.diff(below, axis=1)


def shifted_masses(
    below: FloatArray, grid: FloatArray, loc: FloatArray, scale: FloatArray, edges: FloatArray
) -> FloatArray:
    """Bin probabilities of ``loc + scale * residual``, (n, K); the outer bins get what lies beyond.

    `below` are the masses (n, M + 1) of residuals below the points of a grid.
    """
    n, m = below.shape
    at = edges - loc[:, None]
    at /= scale[:, None]
    at = places_on(grid, at)
    cell = at.astype(np.int32)
    np.minimum(cell, m - 2, out=cell)
    at -= cell
    cell += m * np.arange(n, dtype=np.int32)[:, None]
    low = below.take(cell)
    cell += 1
    high = below.take(cell)
    high -= low
    high *= at
    high += low
    high[:, 0], high[:, -1] = 0, below[:, -1]
    masses = np.subtract(high[:, 1:], high[:, :-1])
    return np.maximum(masses, 0, out=masses)  # rounding may take a step down


def places_on(grid: FloatArray, at: FloatArray) -> FloatArray:
    """Places of values on a grid (M + 1,), in cells from its start: 1.25 is a quarter into the second cell.

    A table gives the places of 4,096 steps of ``x / (c + |x|)``; between these, places are interpolated, in half of the
    time of a search. Where a step holds many cells, there is a search.
    """
    middle, cells = float(np.median(np.abs(grid))) or 1.0, np.arange(float(grid.size))
    ends = np.arange(_STEPS + 1) / (_STEPS / 2) - 1
    with np.errstate(divide="ignore"):
        starts = np.interp(middle * ends / (1 - np.abs(ends)), grid, cells)
    width = np.diff(starts)
    if width.max() > _CELLS_PER_STEP:
        return np.asarray(np.interp(at, grid, cells))
    place = at / (middle + np.abs(at))
    place += 1
    place *= _STEPS / 2
    step = place.astype(np.int32)
    place -= step
    place *= width.take(step, mode="clip")
    place += starts.take(step, mode="clip")
    return place


def log_density(proba: FloatArray, codes: IntArray, widths: FloatArray) -> FloatArray:
    """Log density (n,) that rows of bin probabilities give to the bins `codes`, floored."""
    density = proba[np.arange(codes.size), codes] / widths[codes]
    return np.asarray(np.log(np.maximum(density, _FLOOR / widths.sum())))


def mixture_weights(log_densities: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Weights (m,) of a mixture that maximise the likelihood of densities (n, m), by expectation-maximisation.

    `weight` (n,) are sample weights. Source: the stacking of densities of Smyth and Wolpert (1999).
    """
    relative = np.exp(log_densities - log_densities.max(axis=1, keepdims=True))
    weights = np.full(relative.shape[1], 1 / relative.shape[1])
    for _ in range(_ITERATIONS):
        shares = relative * weights
        weights = np.average(shares / shares.sum(axis=1, keepdims=True), axis=0, weights=weight)
    return weights
