"""A Gaussian process with one length scale per feature, on a subset of rows; predictions out of fold."""

from __future__ import annotations

from typing import Any, Self, TypeAlias

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from conformodal.core.arrays import FloatArray, IntArray

Folds: TypeAlias = list[tuple[IntArray, IntArray]]

# Rows and evaluations of the likelihood: a rough search on few rows, then a finer one from where it ended.
_STAGES = ((250, 40), (600, 20))
# Up to _EXACT_ROWS rows the process is exact. Beyond, _INDUCING of them are its points; beyond _MANY_ROWS fewer.
_EXACT_ROWS = 1200
_INDUCING, _MANY_ROWS, _FEWER_INDUCING = 900, 5000, 600
# beyond so many features they share one length scale
_MOST_LENGTHS = 40
# standard deviations at which a feature is cut off
_REACH = 6.0
# share of the kernel's variance that is added to its diagonal
_JITTER = 1e-8


class SparseProcess:
    """Matern 3/2 process (Rasmussen and Williams 2006, chapters 4, 5 and 8.3.1), its scales by marginal likelihood.

    Beyond 1200 rows it is a regression on 600 to 900 random rows (subset of regressors). A sample's weight divides the
    variance of its noise, so that an integer weight equals as many repetitions.

    Attributes
    ----------
    out_of_fold_ : (n,) prediction of every training value from the other folds, at the scales of all
    """

    out_of_fold_: FloatArray

    def __init__(self, random_state: int) -> None:
        self.random_state = random_state

    def fit(self, X: FloatArray, y: FloatArray, weight: FloatArray, folds: Folds) -> Self:
        """Fit on features (n, p), values (n,) of about unit spread and weights of mean one."""
        self._center, spread = X.mean(axis=0), X.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        features = self._features(X)
        self._mean = float(np.average(y, weights=weight))
        values = y - self._mean
        order = np.random.RandomState(self.random_state).permutation(y.size)
        shared = features.shape[1] > _MOST_LENGTHS
        found: FloatArray | None = None
        for rows, evaluations in _STAGES:
            some = order[:rows]
            found = _search(features[some], values[some], weight[some], evaluations, found, shared)
            if rows >= y.size:
                break
        assert found is not None
        self._inverse = np.broadcast_to(np.exp(-found[:-2]), features.shape[1:])
        self._noise = float(np.exp(found[-1] - found[-2]))  # relative to the kernel's variance
        features = features * self._inverse
        small = y.size <= _EXACT_ROWS
        n_points = _INDUCING if y.size <= _MANY_ROWS else _FEWER_INDUCING
        self._points = features if small else features[order[:n_points]]
        solve = self._solve_exact if small else self._solve_sparse
        self.out_of_fold_ = solve(features, values, weight, folds) + self._mean
        return self

    def _solve_exact(self, features: FloatArray, values: FloatArray, weight: FloatArray, folds: Folds) -> FloatArray:
        kernel = _matern(features, features)
        noisy = kernel + np.diag(self._noise / weight + _JITTER)
        self._slopes = cho_solve((cholesky(noisy, lower=True), True), values)
        found = np.empty(values.size)
        for seen, left_out in folds:
            slopes = cho_solve((cholesky(noisy[np.ix_(seen, seen)], lower=True), True), values[seen])
            found[left_out] = kernel[np.ix_(left_out, seen)] @ slopes
        return found

    def _solve_sparse(self, features: FloatArray, values: FloatArray, weight: FloatArray, folds: Folds) -> FloatArray:
        among = _matern(self._points, self._points)
        among[np.diag_indices_from(among)] += 1e-6
        root = cholesky(among, lower=True)
        basis = solve_triangular(root, _matern(self._points, features), lower=True).T
        weighted = basis * weight[:, None]
        parts = [(basis[left].T @ weighted[left], weighted[left].T @ values[left]) for _, left in folds]
        gram, moment = np.sum([g for g, _ in parts], axis=0), np.sum([m for _, m in parts], axis=0)
        gram[np.diag_indices_from(gram)] += self._noise + _JITTER
        found = np.empty(values.size)
        for (_, left_out), (g, m) in zip(folds, parts, strict=True):
            found[left_out] = basis[left_out] @ cho_solve((cholesky(gram - g, lower=True), True), moment - m)
        slopes = cho_solve((cholesky(gram, lower=True), True), moment)
        self._slopes = solve_triangular(root.T, slopes, lower=False)
        return found

    def predict(self, X: FloatArray) -> FloatArray:
        """Means of the process, (n,)."""
        return np.asarray(_matern(self._features(X) * self._inverse, self._points) @ self._slopes + self._mean)

    def _features(self, X: FloatArray) -> FloatArray:
        return np.asarray(np.clip((X - self._center) / self._scale, -_REACH, _REACH))


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """Distances (n, m) in units of the length scales, times the root of three."""
    squared = np.sum(a * a, axis=1)[:, None] + np.sum(b * b, axis=1) - 2 * a @ b.T
    return np.asarray(np.sqrt(3 * np.maximum(squared, 0, out=squared)))


def _matern(a: FloatArray, b: FloatArray) -> FloatArray:
    r = _distances(a, b)
    return np.asarray((1 + r) * np.exp(-r))


def _search(
    X: FloatArray, y: FloatArray, weight: FloatArray, evaluations: int, start: FloatArray | None, shared: bool
) -> FloatArray:
    """Logarithms of the length scales (p,) or (1,), of the kernel's variance and of the noise's."""
    usual = np.log(2.0) + 0.5 * np.log(X.shape[1])
    n_lengths = 1 if shared else X.shape[1]
    if start is None:
        # a start with little noise finds smooth functions; one with much noise may explain the signal as noise
        start = np.append(np.full(n_lengths, usual), (0.0, np.log(0.01)))
    bounds = [(-4.0, 8.0)] * n_lengths + [(-4.0, 6.0), (-12.0, 2.0)]
    options: Any = {"maxfun": evaluations, "maxiter": evaluations}
    found = minimize(
        _unlikelihood, start, (X, y, weight, usual), jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    return np.asarray(found.x)


def _unlikelihood(
    at: FloatArray, X: FloatArray, y: FloatArray, weight: FloatArray, usual: float
) -> tuple[float, FloatArray]:
    """Negative log marginal likelihood, with a weak prior on the length scales; and its gradient."""
    variance, noise = np.exp(at[-2]), np.exp(at[-1]) / weight
    scaled = X * np.exp(-at[:-2])
    r = _distances(scaled, scaled)
    decay = np.exp(-r)
    kernel = variance * (1 + r) * decay
    diagonal = np.diag_indices(y.size)
    noisy = kernel.copy()
    noisy[diagonal] += noise + _JITTER * variance
    try:
        root = cholesky(noisy, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return 1e25, np.zeros(at.size)
    slopes = cho_solve((root, True), y, check_finite=False)
    inverse = np.tril(dpotri(root, lower=1)[0])
    inverse = inverse + np.tril(inverse, -1).T
    outer = np.outer(slopes, slopes) - inverse
    # by a log length scale the kernel changes by 3 variance decay times the squared distance along its feature
    change = outer * decay * (3 * variance)
    by_length = change.sum(axis=1) @ scaled**2 - np.sum(scaled * (change @ scaled), axis=0)
    lengths = at[:-2] - usual
    gradient = np.empty(at.size)
    gradient[:-2] = -(by_length if lengths.size == X.shape[1] else by_length.sum()) + lengths / 4
    gradient[-2] = -0.5 * float(np.sum(outer * kernel))
    gradient[-1] = -0.5 * float(outer[diagonal] @ noise)
    value = 0.5 * float(y @ slopes) + float(np.log(np.diag(root)).sum()) + float(lengths @ lengths) / 8
    return value, gradient
