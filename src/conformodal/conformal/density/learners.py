"""Learners of one target's distribution: densities by name, or any classifier, smoothed over bin numbers."""

from __future__ import annotations

import warnings
from fractions import Fraction
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr
from sklearn.base import clone

from conformodal.conformal.bins import nearest_bins
from conformodal.conformal.checks import as_doubles, brief
from conformodal.conformal.choice import LeftOut
from conformodal.core.arrays import AnyArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .distributions import DistributionRegressor, reader_of
from .encoder import rows_of
from .mixture import log_density, mixture_weights
from .named import QuickDensity, StackedDensity

LearnerName = Literal["quick", "stack"]

# fits of a classifier, each on all rows but every fifth; of fewer rows none is left out
_FOLDS = 5
_FEWEST_TO_LEAVE_OUT = 20
# standard deviations, in bins, of the Gaussians that the probabilities are smoothed by; 0 does not smooth
_SIGMAS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
# (s, f): a Gaussian around the mean, its variance that of s bins and of f times the row's own standard deviation
_AROUND_MEAN = ((1.0, 0.0), (2.0, 0.0), (4.0, 0.0), (8.0, 0.0), (0.5, 0.25), (0.5, 0.5), (0.5, 1.0))
_N_COMPONENTS = len(_SIGMAS) + len(_AROUND_MEAN) + 1
# a repeated value stands out if it is so many times as frequent as the values in either bin beside it
_STANDS_OUT = 4.0
_TINY = float(np.finfo(np.float64).tiny)


def as_learner(estimator: Any, random_state: int) -> tuple[Any, bool]:
    """The learner that `estimator` names or is, and whether it learns densities over bins."""
    if estimator is None or estimator in get_args(LearnerName):
        return (StackedDensity if estimator == "stack" else QuickDensity)(random_state=random_state), True
    if not isinstance(estimator, type) and not hasattr(estimator, "fit_bins") and reader_of(estimator) is not None:
        estimator = DistributionRegressor(estimator)
    dense = hasattr(estimator, "fit_bins")
    methods = ("fit_bins" if dense else "fit", "predict_proba", "get_params")
    if isinstance(estimator, type) or not all(hasattr(estimator, method) for method in methods):
        names = list(get_args(LearnerName))
        raise ConformodalError(f"estimator must be one of {names}, None or a classifier, got {brief(estimator)}")
    return estimator, dense


def split_off(
    n: int, share: float, random: np.random.RandomState, codes: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Calibration samples, of each group with one of the `codes` (n,), and the others, of which 2 must be left."""
    order = random.permutation(n)
    n_held = int(np.ceil(share * n))
    if codes is not None:
        rank = np.empty(n, dtype=np.int64)
        for code in np.unique(codes):
            members = order[codes[order] == code]
            rank[members] = np.arange(members.size) >= np.ceil(share * members.size)
        order = order[np.argsort(rank[order], kind="stable")]
        n_held = n - int(rank.sum())
    if n - n_held < 2:
        each = "" if codes is None else f", 1 or more of each of {counted(np.unique(codes).size, 'group')}"
        raise ConformodalError(
            f"X has n_samples={n}, {n_held} of which are held out to calibrate{each}: at least 2 must be left"
        )
    return order[:n_held], order[n_held:]


def split_units(
    units: AnyArray, share: float, alpha: Fraction, random: np.random.RandomState
) -> tuple[IntArray, IntArray]:
    """Calibration samples, of whole units, up to half of them if bounded sets need so many; and the others."""
    distinct, codes = np.unique(units, return_inverse=True)
    n_held = max(int(np.ceil(share * distinct.size)), min(distinct.size // 2, int(1 / alpha))) if share else 0
    if distinct.size < n_held + 2:
        raise ConformodalError(f"units must be 2 or more beside the {n_held} that calibrate, got {distinct.size}")
    held = np.isin(codes, random.permutation(distinct.size)[:n_held])
    return random.permutation(np.flatnonzero(held)), random.permutation(np.flatnonzero(~held))


class FittedTarget(NamedTuple):
    """A learner fitted on one target, and predictions for training rows that it has not learnt from."""

    model: Any
    first: FloatArray | None  # probabilities of the first rows, if asked for and if there are enough rows
    left_out: LeftOut | None  # of rows that cost no further fit, and the bins of their values


def fit_target(
    base: Any, dense: bool, X: Any, y: FloatArray, edges: FloatArray, weight: FloatArray | None, out_of_fold: bool
) -> FittedTarget:
    """Clones of the learner, fitted on one target.

    A classifier is fitted five times without every fifth row, which tunes the smoothing; the five are averaged. A
    density is fitted on all rows, and for ``out_of_fold=True`` again without the first half. With fewer than 20 rows,
    none is left out. Rows must be in random order.
    """

    def fitted(rows: Any) -> Any:
        share = {} if weight is None else {"sample_weight": weight[rows]}
        try:
            if dense:
                return clone(base).fit_bins(rows_of(X, rows), y[rows], edges, **share)
            return BinClassifier(clone(base), rows_of(X, rows), y[rows], edges, share)
        except ConformodalError:
            raise
        except (ValueError, TypeError) as exc:
            raise ConformodalError(f"estimator cannot be fitted: {brief(exc, 300)}") from exc

    n, fold = len(y), np.arange(len(y)) % _FOLDS
    enough = n >= _FEWEST_TO_LEAVE_OUT
    if dense:
        model, first = fitted(slice(None)), None
        left_out: LeftOut | None = vars(model).pop("left_out_", None)  # that files need not hold
        if enough and out_of_fold:
            first = predict_proba(fitted(slice(n // 2, None)), rows_of(X, slice(n // 2)))
            left_out = left_out or (first, nearest_bins(y[: n // 2], edges))
        return FittedTarget(model, first, left_out)
    smoothing = BinSmoothing(y, edges, weight)
    if not enough:
        return FittedTarget(SmoothedClassifier([fitted(slice(None))], smoothing), None, None)
    models, proba = [], np.empty((n, edges.size - 1))
    for k in range(_FOLDS):
        models.append(fitted(fold != k))
        proba[fold == k] = predict_proba(models[-1], rows_of(X, fold == k))
    smoothing.tune(proba, y, edges, weight)
    smoothed = smoothing(proba)
    return FittedTarget(SmoothedClassifier(models, smoothing), smoothed, (smoothed, nearest_bins(y, edges)))


def predict_proba(model: Any, X: Any) -> FloatArray:
    """Probabilities (n, K) of a fitted density or classifier."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # scikit-learn reports overflows
            return as_doubles(model.predict_proba(X), "predict_proba of the estimator")
    except ConformodalError:
        raise
    except (ValueError, TypeError) as exc:
        raise ConformodalError(f"estimator cannot predict: {brief(exc, 300)}") from exc


class BinClassifier:
    """A classifier of those of all bins that hold training values, which it knows as 0, 1, ...: some demand that."""

    def __init__(self, model: Any, X: Any, y: FloatArray, edges: FloatArray, options: dict[str, Any]) -> None:
        self.bins, labels = np.unique(nearest_bins(y, edges), return_inverse=True)
        self.n_bins, self.model = edges.size - 1, None
        if self.bins.size == 1:
            return
        with np.errstate(over="ignore", invalid="ignore"), warnings.catch_warnings():  # scikit-learn reports overflows
            warnings.filterwarnings("ignore", message="The number of unique classes")  # as if it were no classification
            self.model = model.fit(X, labels, **options)

    def predict_proba(self, X: Any) -> FloatArray:
        """Probabilities (n, K) of all bins; 0 for bins without training values."""
        proba = np.zeros((X.shape[0], self.n_bins))
        if self.model is None:
            proba[:, self.bins] = 1.0
            return proba
        columns = predict_proba(self.model, X)
        classes = np.asarray(getattr(self.model, "classes_", np.arange(self.bins.size)), dtype=np.int64)
        if columns.shape != (len(proba), classes.size):
            shape = f"({len(proba)}, {classes.size}), got {columns.shape}"
            raise ConformodalError(f"predict_proba of the estimator must have shape {shape}")
        proba[:, self.bins[classes]] = columns
        return proba


class SmoothedClassifier:
    """The smoothed mean of fitted classifiers."""

    def __init__(self, classifiers: list[BinClassifier], smoothing: BinSmoothing) -> None:
        self.classifiers = classifiers
        self.smoothing = smoothing

    def predict_proba(self, X: Any) -> FloatArray:
        """Probabilities (n, K) of the bins."""
        return self.smoothing(np.mean([one.predict_proba(X) for one in self.classifiers], axis=0))


class BinSmoothing:
    """A mixture of a classifier's smoothed probabilities, Gaussians around their mean, and the bins' frequencies.

    A bin of one repeated value, several times as frequent as the bins beside it (such as zeros in a continuous target),
    exchanges no probability with others. Until :meth:`tune` is called, all components weigh the same.
    """

    def __init__(self, y: FloatArray, edges: FloatArray, weight: FloatArray | None) -> None:
        codes, n_bins = nearest_bins(y, edges), edges.size - 1
        counts = np.bincount(codes, weight, minlength=n_bins)
        self.marginal = (counts + 1 / n_bins) / (counts.sum() + 1)  # one more row, spread over all bins
        low, high = np.full(n_bins, np.inf), np.full(n_bins, -np.inf)
        np.minimum.at(low, codes, y)
        np.maximum.at(high, codes, y)
        beside = np.maximum(np.append(counts[1:], 0), np.append(0, counts[:-1]))
        repeated = (low == high) & (counts > _STANDS_OUT * beside) & (np.bincount(codes, minlength=n_bins) > 1)
        self.kinds = [kind.astype(np.float64) for kind in (repeated, ~repeated) if kind.any()]
        self.weights = np.full(_N_COMPONENTS, 1 / _N_COMPONENTS)

    def tune(self, proba: FloatArray, y: FloatArray, edges: FloatArray, weight: FloatArray | None) -> None:
        """Set the weights of the components by the likelihood of left-out values; each keeps a share of one row."""
        codes, widths = nearest_bins(y, edges), np.diff(edges)
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
