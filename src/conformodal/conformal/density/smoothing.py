"""Any classifier as a density over bins: its probabilities, smoothed over bin numbers; none is zero."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from conformodal.conformal.checks import as_doubles, reason
from conformodal.conformal.errors import ConformodalError
from conformodal.core.arrays import FloatArray, IntArray

from .mixture import log_density, mixture_weights

# standard deviations, in bins, of the Gaussians that the probabilities are smoothed by; 0 does not smooth
_SIGMAS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# (s, f): a Gaussian around the mean, its variance that of s bins and of f times the row's own standard deviation
_AROUND_MEAN = ((1.0, 0.0), (2.0, 0.0), (4.0, 0.0), (8.0, 0.0), (0.5, 0.25), (0.5, 0.5), (0.5, 1.0))
_N_COMPONENTS = len(_SIGMAS) + len(_AROUND_MEAN) + 1
# a repeated value stands out if it is so many times as frequent as the values in either bin beside it
_STANDS_OUT = 4.0
_TINY = float(np.finfo(np.float64).tiny)


class BinSmoothing:
    """A mixture of a classifier's smoothed probabilities, Gaussians around their mean, and the bins' frequencies.

    Gaussians are over bin numbers, of several widths. A bin of one repeated value, several times as frequent as the
    bins beside it (such as zeros in a continuous target), exchanges no probability with others. Until :meth:`tune` is
    called, all components weigh the same.

    `codes` (n,) are the bins of the training values `y` (n,), `weight` their weights or None.
    """

    def __init__(self, codes: IntArray, y: FloatArray, weight: FloatArray | None, n_bins: int) -> None:
        counts = np.bincount(codes, weight, minlength=n_bins)
        self.marginal = (counts + 1 / n_bins) / (counts.sum() + 1)  # one more row, spread over all bins
        low, high = np.full(n_bins, np.inf), np.full(n_bins, -np.inf)
        np.minimum.at(low, codes, y)
        np.maximum.at(high, codes, y)
        beside = np.maximum(np.append(counts[1:], 0), np.append(0, counts[:-1]))
        repeated = (low == high) & (counts > _STANDS_OUT * beside) & (np.bincount(codes, minlength=n_bins) > 1)
        self.kinds = [kind.astype(np.float64) for kind in (repeated, ~repeated) if kind.any()]
        self.weights = np.full(_N_COMPONENTS, 1 / _N_COMPONENTS)

    def tune(self, proba: FloatArray, codes: IntArray, widths: FloatArray, weight: FloatArray | None) -> None:
        """Set the weights of the components by the likelihood of left-out values; each keeps a share of one row.

        `proba` (m, K) are out-of-fold probabilities, `codes` (m,) the bins of the values, `widths` (K,) of the bins and
        `weight` (m,) of the rows, or None.
        """
        components = [log_density(self._component(proba, i), codes, widths) for i in range(self.weights.size)]
        likeliest = mixture_weights(np.column_stack(components), weight)
        self.weights = (codes.size * likeliest + 1 / likeliest.size) / (codes.size + 1)

    def __call__(self, proba: FloatArray) -> FloatArray:
        """Smoothed probabilities (n, K); none is zero."""
        total = sum(share * self._component(proba, i) for i, share in enumerate(self.weights))
        return np.asarray(total / np.sum(total, axis=1, keepdims=True))

    def _component(self, proba: FloatArray, i: int) -> FloatArray:
        if i == _N_COMPONENTS - 1:
            return np.broadcast_to(self.marginal, proba.shape)
        total = np.zeros(proba.shape)
        for kind in self.kinds:
            part = proba * kind
            if i >= len(_SIGMAS):
                total += _around_mean(part, kind, *_AROUND_MEAN[i - len(_SIGMAS)])
            elif _SIGMAS[i]:  # what would go to bins of the other kind, or beyond the ends, goes to the others
                reach = np.maximum(_gaussian(kind, _SIGMAS[i]), _TINY)
                total += kind * _gaussian(part / reach, _SIGMAS[i])
            else:
                total += part
        return total


def _around_mean(part: FloatArray, kind: FloatArray, sigma: float, factor: float) -> FloatArray:
    """The mass of each row of `part`, as a Gaussian around its mean over the bins of a `kind`."""
    n_bins, mass = kind.size, part.sum(axis=1)
    place, share = np.arange(n_bins) + 0.5, part / np.maximum(mass, _TINY)[:, None]
    mean = share @ place
    spread = np.sqrt(sigma**2 + factor**2 * np.maximum(share @ place**2 - mean**2, 0))
    below = ndtr((np.arange(n_bins + 1) - mean[:, None]) / spread[:, None])
    below[:, 0], below[:, -1] = 0, 1
    gaussian = np.diff(below, axis=1) * kind
    reached = gaussian.sum(axis=1, keepdims=True)
    gaussian = np.divide(gaussian, reached, out=share, where=reached > _TINY)  # far from all bins of the kind: as it is
    return np.asarray(gaussian * mass[:, None])


def _gaussian(values: FloatArray, sigma: float) -> FloatArray:
    return np.asarray(gaussian_filter1d(values, sigma, axis=-1, mode="constant"))


@dataclass
class BinClassifier:
    """A classifier of those of all bins that hold training values, which it knows as 0, 1, ...: some demand that."""

    model: Any
    bins: IntArray


class SmoothedClassifier:
    """The smoothed mean of fitted classifiers (or numbers of the only bin that they saw)."""

    def __init__(self, classifiers: list[Any], smoothing: BinSmoothing) -> None:
        self.classifiers = classifiers
        self.smoothing = smoothing

    def predict_proba(self, X: Any) -> FloatArray:
        """Probabilities (n, K) of the bins."""
        by_classifier = [proba_of_bins(one, X, self.smoothing.marginal.size) for one in self.classifiers]
        return self.smoothing(np.asarray(np.mean(by_classifier, axis=0)))


def bin_codes(y: FloatArray, edges: FloatArray) -> IntArray:
    """Bins (n,) of values; values beyond the edges are in the outer bins."""
    return np.searchsorted(edges[1:-1], y, side="right")


def fit_classifier(model: Any, X: Any, y: FloatArray, edges: FloatArray, weight: FloatArray | None = None) -> Any:
    """Fit a classifier on bin numbers; if all values are in one bin, its number stands for the classifier."""
    bins, labels = np.unique(bin_codes(y, edges), return_inverse=True)
    if bins.size == 1:
        return int(bins[0])
    with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():  # scikit-learn reports overflows
        warnings.filterwarnings("ignore", message="The number of unique classes")  # as if it were no classification
        fitted = model.fit(X, labels, **({} if weight is None else {"sample_weight": weight}))
    return BinClassifier(fitted, bins)


def proba_of_bins(model: Any, X: Any, n_bins: int) -> FloatArray:
    """Probabilities (n, K) of all bins; 0 for bins without training values."""
    bins: Any = None
    if isinstance(model, BinClassifier):
        model, bins = model.model, model.bins
    if isinstance(model, int):
        return np.tile(np.arange(n_bins) == model, (X.shape[0], 1)).astype(np.float64)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # scikit-learn reports overflows
            given = model.predict_proba(X)
    except ConformodalError:
        raise
    except (ValueError, TypeError) as exc:
        raise ConformodalError(f"estimator cannot predict: {reason(exc)}") from exc
    columns = as_doubles(given, "predict_proba of the estimator")
    if bins is None:
        return columns
    classes = np.asarray(getattr(model, "classes_", np.arange(bins.size)), dtype=np.int64)
    if columns.shape != (X.shape[0], classes.size):
        raise ConformodalError(
            f"predict_proba of the estimator must have shape ({X.shape[0]}, {classes.size}), got {columns.shape}"
        )
    proba = np.zeros((X.shape[0], n_bins))
    proba[:, bins[classes]] = columns
    return proba
