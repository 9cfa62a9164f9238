"""The densities that have names: the default, which takes seconds, and a sharper and slower one."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize, nnls
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.ensemble import BaggingRegressor, ExtraTreesRegressor, HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from sklearn.metrics import euclidean_distances
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils import check_random_state, gen_batches
from threadpoolctl import threadpool_limits

from conformodal.core.arrays import FloatArray, IntArray

from .forest import LeafForest, group_values, rank_cosines
from .mixture import MixtureDensity, log_spread

Maker: TypeAlias = Callable[[], Any]
_minimize: Any = minimize  # whose stubs know no such function
Folds: TypeAlias = list[tuple[IntArray, IntArray]]

# a second boosting, of smaller trees, is fitted on at most so many rows
_SECOND_ROWS = 700
# of more rows, boosting grows half as many trees of twice as many leaves, which are as good and answer faster
_MANY_ROWS = 8000
# the Gaussian process of the stack is fitted on at most so many rows
_PROCESS_ROWS = 1500
# that of the quick density on at most so many, its kernel found on fewer, in at most so many steps
_SMOOTH_ROWS, _KERNEL_ROWS, _KERNEL_STEPS = 1000, 300, 30
# columns beyond which they share one length scale; standard deviations of the prior of its logarithm, and at which a
# column is cut off
_MAX_LENGTHS, _PRIOR_SD, _REACH = 40, 2.0, 6.0
# least weight in the location; of many rows more, as its answers take longer than those of all trees
_MIN_SHARE, _MIN_SHARE_OF_MANY = 0.05, 0.2
_KERNEL_BLOCK = 256  # rows whose kernel fits into a cache
_JITTER = 1e-8  # least variance of noise, for a matrix that can be inverted
# networks of the stack; gradient steps of each: rows times epochs, within limits
_NETWORKS, _ROWS_SEEN = 3, 600_000
# columns that a model of a location or spread gets, or as many as there are rows if these are more
_MAX_COLUMNS = 128
# (rows, trees, folds): trees of a forest and folds of the quick density for at most so many rows
_TREES_AND_FOLDS = ((1500, 60, 5), (3000, 60, 3), (5000, 40, 3), (8000, 30, 3), (np.inf, 20, 2))
# rows that the quick density learns from, drawn at random if there are more; held-out rows that choose its weights
_MAX_ROWS, _VALIDATION_ROWS = 30_000, 1000


class QuickDensity(MixtureDensity):
    """Conditional density of a value over bins, order-aware, in about the time of a few boostings.

    A smaller :class:`~conformodal.conformal.StackedDensity`. Boosted trees, a forest and a Gaussian process, if it
    helps, give every sample an out-of-fold location; boosted trees give its spread. Five distributions are mixed by the
    weights of largest held-out likelihood:

    - the marginal distribution of the values;
    - residuals from the location, scaled by the spread, the same for all samples;
    - scaled residuals, weighted by a forest on features and location (:class:`~.forest.LeafForest`);
    - values, weighted by the same forest;
    - values, weighted by a forest on the features alone, for multimodal values, which have no single location.

    Each is smoothed by Gaussian kernels, narrower where values are dense; held-out likelihood chooses the bandwidth.
    Of more than 30,000 rows, so many are drawn at random. Boosted trees get at most 128 columns, or as many as there
    are rows: those that correlate most with the values that each is fitted on. The Gaussian process gets at most 1,000
    rows, and has one length scale per column of up to 40.

    Parameters
    ----------
    random_state
        Seed, or None.

    Attributes
    ----------
    edges_ : (K + 1,) edges of the bins
    weights_ : (5,) of the mixture, in the order above

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuickDensity
    >>> rng = np.random.default_rng(0)
    >>> X = rng.random((60, 1))
    >>> y = X[:, 0] + rng.choice([-1, 1], 60)
    >>> density = QuickDensity(random_state=0).fit_bins(X, y, edges=[-1, 0, 1, 2])
    >>> density.predict_proba([[0.5]]).shape
    (1, 3)
    """

    def __init__(self, random_state: Any = None) -> None:
        self.random_state = random_state

    def fit_bins(
        self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None
    ) -> Self:
        """Learn the density of `y` (n,) given `X`, any table (n, p), over bins with `edges` (K + 1,).

        Rows of weight 0 are left out; bandwidths are chosen as if all others weighed the same.
        """
        random = check_random_state(self.random_state)
        features, z, weight = self._standardise(X, y, edges, sample_weight)
        seed = int(random.randint(2**31 - 1))
        if z.size > _MAX_ROWS:
            kept = random.permutation(z.size)[:_MAX_ROWS]
            features, z, weight = features[kept], z[kept], weight[kept]
        n = z.size
        validation = random.permutation(n)[:_VALIDATION_ROWS]
        n_trees, n_folds = next(both for most, *both in _TREES_AND_FOLDS if n <= most)
        with threadpool_limits(1):  # waiting threads spin: on a busy core that costs minutes
            values = group_values(z)
            direct = LeafForest(ExtraTreesRegressor, n_trees, 3, seed)
            direct.fit(features, rank_cosines(z, 4), z, weight, [values], validation)
            means, members = direct.out_of_bag_mean_, quick_members(n, seed)
            smooth, folds = smooth_member(features, z, seed), folds_of(n, seed, n_folds)
            self.location_ = Location().fit(members, features, z, weight, folds, means, smooth)
            summary = self.location_.summary(self.location_.out_of_fold_)
            loc, extended = summary[:, 0], np.column_stack((features, summary))
            size = (0.1, 40, 8, 20) if n <= _MANY_ROWS else (0.2, 20, 15, 20)
            rough, folds = boosting(*size, n, seed), folds_of(n, seed, min(n_folds, 3))
            log_spreads, self.spread_ = fit_out_of_fold(rough, extended, log_spread(z - loc), weight, folds)
            spread = np.exp(log_spreads)
            scaled = (z - loc) / spread
            residuals = group_values(scaled)
            guided = LeafForest(ExtraTreesRegressor, n_trees, 5, seed + 1)
            both = np.column_stack((rank_cosines(scaled, 2), rank_cosines(z, 4)))
            guided.fit(extended, both, z, weight, [residuals, values], validation)
        self.forests_ = guided, direct
        by_forest = [*guided.out_of_bag_, *direct.out_of_bag_]
        self._mix(z, weight, (loc, spread), (values, residuals), by_forest, validation)
        return self


class StackedDensity(MixtureDensity):
    """Conditional density of a value over bins, order-aware; slower and sharper than :class:`QuickDensity`.

    It mixes the same five distributions. Its location is that of boosted trees, random trees, networks and, on small
    tables, a Gaussian process; its spread and the weights of its distributions come from random forests, one for each.
    A thousand rows of ten columns take some minutes.

    ``ConformalRegressor("stack")`` uses it. For an example see :class:`QuickDensity`.

    Parameters
    ----------
    n_trees
        Trees of each of the forests.
    random_state
        Seed, or None.

    Attributes
    ----------
    edges_ : (K + 1,) edges of the bins
    weights_ : (5,) of the mixture, in the order of `QuickDensity`
    """

    def __init__(self, n_trees: int = 100, random_state: Any = None) -> None:
        self.n_trees = n_trees
        self.random_state = random_state

    def fit_bins(self, X: npt.ArrayLike, y: npt.ArrayLike, edges: npt.ArrayLike) -> Self:
        """Learn the density of `y` (n,) given `X`, any table (n, p), over bins with `edges` (K + 1,)."""
        features, z, weight = self._standardise(X, y, edges)
        n, seed = z.size, int(check_random_state(self.random_state).randint(2**31 - 1))
        with warnings.catch_warnings():  # networks stop at their last epoch, rows are in the bags of all trees
            warnings.simplefilter("ignore", ConvergenceWarning)
            warnings.filterwarnings("ignore", message="Some inputs do not have OOB scores")
            warnings.filterwarnings("ignore", category=RuntimeWarning, message="invalid value encountered")
            members, folds = stacked_members(n, seed), folds_of(n, seed, 5)
            self.location_ = Location().fit(members, features, z, weight, folds)
            summary = self.location_.summary(self.location_.out_of_fold_)
            extended, residual = np.column_stack((features, summary)), z - summary[:, 0]
            self.spread_ = RandomForestRegressor(
                2 * self.n_trees, min_samples_leaf=10, max_features=0.5, random_state=seed
            ).set_params(oob_score=_oob_mean)
            self.spread_.fit(extended, log_spread(residual))
        predicted = self.spread_.oob_prediction_
        mean = np.nanmean(predicted) if np.isfinite(predicted).any() else 0.0  # for rows in the bags of all trees
        spread = np.exp(np.where(np.isfinite(predicted), predicted, mean))
        values, residuals = group_values(z), group_values(residual / spread)
        self.forests_ = tuple(
            LeafForest(RandomForestRegressor, self.n_trees, least, seed).fit(
                given, rank_cosines(of, 4), of, weight, [groups], np.arange(n)
            )
            for least, given, of, groups in (
                (30, extended, residual / spread, residuals),
                (3, extended, z, values),
                (10, features, z, values),
            )
        )
        by_forest = [forest.out_of_bag_[0] for forest in self.forests_]
        self._mix(z, weight, (summary[:, 0], spread), (values, residuals), by_forest, np.arange(n))
        return self


def _oob_mean(truth: FloatArray, predicted: FloatArray) -> float:
    """A dummy score, for which the forest keeps its out-of-bag predictions."""
    return 0.0


class Location:
    """Predictions of the location of a value, weighted by non-negative least squares (Breiman 1996).

    `out_of_fold_` are the predictions (n, m) of every training value by models that did not see it; `weights_` (m,) of
    the models sum to one.
    """

    def fit(
        self,
        members: list[Maker],
        X: FloatArray,
        y: FloatArray,
        weight: FloatArray,
        folds: Folds,
        forest: Any = None,
        smooth: Maker | None = None,
    ) -> Self:
        """Fit untrained `members`; `forest` (n,) are out-of-bag means of one more.

        The member `smooth` stays out unless its weight is a twentieth or more, of many rows a fifth.
        """
        fits = [fit_out_of_fold(member, X, y, weight, folds) for member in members]
        self._models = [model for _, model in fits]
        self._with_forest = forest is not None
        self.out_of_fold_ = np.column_stack([*(guess for guess, _ in fits), *([] if forest is None else [forest])])
        self.weights_ = _stacking_weights(self.out_of_fold_, y, weight)
        if smooth is None:
            return self
        guess, model = fit_out_of_fold(smooth, X, y, weight, folds)
        wider = np.column_stack((guess, self.out_of_fold_))
        weights = _stacking_weights(wider, y, weight)
        if weights[0] >= (_MIN_SHARE if y.size <= _MANY_ROWS else _MIN_SHARE_OF_MANY):
            self._models, self.out_of_fold_, self.weights_ = [model, *self._models], wider, weights
        return self

    def predict(self, X: FloatArray, forest: FloatArray) -> FloatArray:
        """:meth:`summary` of the predictions for new samples."""
        predictions = [model.predict(X) for model in self._models]
        return self.summary(np.column_stack([*predictions, forest] if self._with_forest else predictions))

    def summary(self, predictions: FloatArray) -> FloatArray:
        """The weighted mean and the standard deviation of the members' predictions (n, m), as (n, 2)."""
        return np.column_stack((predictions @ self.weights_, predictions.std(axis=1)))


def _stacking_weights(predictions: FloatArray, y: FloatArray, weight: FloatArray) -> FloatArray:
    """Weights (m,) of out-of-fold predictions (n, m), not negative, that sum to one."""
    root = np.sqrt(weight)
    raw, _ = nnls(predictions * root[:, None], y * root)
    return np.asarray(raw / raw.sum() if raw.sum() > 0 else np.full(raw.size, 1 / raw.size))


def quick_members(n: int, seed: int) -> list[Maker]:
    """Boosted trees, on small tables of two kinds."""
    size = (0.15, 150, 15, 5) if n <= _MANY_ROWS else (0.15, 75, 31, 5)
    members = [boosting(*size, n, seed)]
    if n <= _SECOND_ROWS:
        members.append(boosting(0.1, 300, 8, 5, n, seed))
    return members


def stacked_members(n: int, seed: int) -> list[Maker]:
    """Boosted trees, random trees, networks and, on small tables, an exact Gaussian process."""

    def networks(decay: float, rate: float) -> Maker:
        one = MLPRegressor(
            hidden_layer_sizes=(64, 64),
            alpha=decay,
            learning_rate_init=rate,
            max_iter=int(np.clip(_ROWS_SEEN // n, 30, 400)),
            n_iter_no_change=1000,  # no early stopping: the folds of the stack guard against overfitting
            random_state=seed,
        )
        return lambda: make_pipeline(
            StandardScaler(), BaggingRegressor(one, _NETWORKS, bootstrap=False, random_state=seed)
        )

    boosters = [boosting(0.05, 500, 31, 10, n, seed), boosting(0.05, 1000, 8, 5, n, seed)]
    members = [
        *boosters,
        lambda: ExtraTreesRegressor(200, random_state=seed),
        networks(1e-3, 5e-3),
        networks(0.1, 1e-2),
    ]
    if n <= _PROCESS_ROWS:
        members.append(lambda: make_pipeline(StandardScaler(), _AnisotropicProcess()))
    return members


def smooth_member(X: FloatArray, y: FloatArray, seed: int) -> Maker | None:
    """A Gaussian process whose kernel has the largest marginal likelihood on some of the rows; None if there is none.

    Length scales have a log-normal prior: without one, the search often ends where all is noise.
    """
    rows = np.random.RandomState(seed).permutation(y.size)[:_KERNEL_ROWS]
    features = _standardised(X[rows], X.mean(axis=0), X.std(axis=0))
    lengths = np.full(X.shape[1] if X.shape[1] <= _MAX_LENGTHS else 1, 2 * np.sqrt(X.shape[1]))
    amplitude, noise = ConstantKernel(1.0, (1e-2, 1e3)), WhiteKernel(0.1, (1e-5, 10.0))
    kernel = amplitude * Matern(lengths, (1e-2, 1e4), nu=1.5) + noise
    usual = np.log(lengths)

    def search(unlikelihood: Any, start: FloatArray, bounds: FloatArray) -> tuple[FloatArray, float]:
        def penalised(at: FloatArray) -> tuple[float, FloatArray]:
            value, gradient = unlikelihood(at)
            away = np.concatenate(([0.0], at[1:-1] - usual, [0.0]))  # amplitude, lengths, noise
            return value + float(away @ away) / (2 * _PRIOR_SD**2), gradient + away / _PRIOR_SD**2

        options: Any = {"jac": True, "method": "L-BFGS-B", "options": {"maxiter": _KERNEL_STEPS}}
        best = _minimize(penalised, start, bounds=bounds, **options)
        return best.x, float(best.fun)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a useless feature's length scale runs to its bound
        try:
            best = GaussianProcessRegressor(kernel, optimizer=search).fit(features, y[rows]).kernel_
        except (np.linalg.LinAlgError, ValueError):  # no kernel fits, as of a constant
            return None
    return lambda: SubsetProcess(best.k1, float(best.k2.noise_level), seed)


def _standardised(X: FloatArray, center: FloatArray, spread: FloatArray) -> FloatArray:
    return np.asarray(np.clip((X - center) / np.where(spread > 0, spread, 1.0), -_REACH, _REACH))


class SubsetProcess(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Gaussian process with a given kernel and variance of noise, on at most 1,000 rows.

    A row's weight divides the variance of its noise, so that a whole weight equals as many repetitions. Source:
    Rasmussen and Williams (2006), equation 2.25; of more rows a random subset, chapter 8.3.3.
    """

    def __init__(self, kernel: Any, noise: float, random_state: int) -> None:
        self.kernel = kernel
        self.noise = noise
        self.random_state = random_state

    def fit(self, X: FloatArray, y: FloatArray, sample_weight: FloatArray | None = None) -> Self:
        """Take in the rows (n, p), or a random subset."""
        rows = np.random.RandomState(self.random_state).permutation(y.size)[:_SMOOTH_ROWS]
        weight = np.ones(y.size) if sample_weight is None else sample_weight
        self.mean_ = float(np.average(y, weights=weight))
        self.center_ = np.average(X, axis=0, weights=weight)
        self.spread_ = np.sqrt(np.average((X - self.center_) ** 2, axis=0, weights=weight))
        process = GaussianProcessRegressor(self.kernel, alpha=self.noise / weight[rows] + _JITTER, optimizer=None)
        self.process_ = process.fit(_standardised(X[rows], self.center_, self.spread_), y[rows] - self.mean_)
        return self

    def predict(self, X: FloatArray) -> FloatArray:
        """Means (n,), as of scikit-learn's process, which takes eight times as long over its kernel."""
        features = _standardised(X, self.center_, self.spread_)
        amplitude, matern = self.process_.kernel_.k1.constant_value, self.process_.kernel_.k2
        per_length = np.sqrt(3) / matern.length_scale
        known, asked = self.process_.X_train_ * per_length, np.zeros((_KERNEL_BLOCK, features.shape[1]))
        squares, means = (known**2).sum(axis=1)[None], np.empty(len(features))
        for rows in gen_batches(len(features), _KERNEL_BLOCK):
            n = rows.stop - rows.start
            asked[:n] = features[rows] * per_length  # always as many rows: products of other shapes round differently
            away = euclidean_distances(asked, known, Y_norm_squared=squares)
            means[rows] = (((1 + away) * np.exp(-away)) @ self.process_.alpha_)[:n]
        return np.asarray(amplitude * means + self.mean_)


class _AnisotropicProcess(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Gaussian process with one length scale per feature (Rasmussen and Williams 2006, chapter 5)."""

    def fit(self, X: FloatArray, y: FloatArray) -> Self:
        kernel = ConstantKernel(1.0) * Matern(np.ones(X.shape[1]), nu=1.5) + WhiteKernel(0.05)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a useless feature's length scale runs to its bound
            self.process_ = GaussianProcessRegressor(kernel, normalize_y=True).fit(X, y)
        return self

    def predict(self, X: FloatArray) -> FloatArray:
        return np.asarray(self.process_.predict(X))


class _ScreeningRegressor:
    """A regressor on the columns that correlate most with the values that it is fitted on."""

    def __init__(self, model: Any, most: int) -> None:
        self.model = model
        self.most = most

    def fit(self, X: FloatArray, y: FloatArray, **options: Any) -> Self:
        self.columns = most_correlated(X, y[:, None], self.most)
        self.model.fit(X[:, self.columns], y, **options)
        return self

    def predict(self, X: FloatArray) -> FloatArray:
        return np.asarray(self.model.predict(X[:, self.columns]))


def most_correlated(X: FloatArray, y: FloatArray, most: int) -> IntArray:
    """The columns of `X` (n, p), at most so many, that correlate most with a column of `y` (n, d)."""
    apart = X - X.mean(axis=0)
    spread = np.maximum(np.sqrt((apart**2).sum(axis=0)), 1e-300)
    strength = np.abs(apart.T @ (y - y.mean(axis=0)) / spread[:, None]).max(axis=1)
    return np.sort(strength.argsort(kind="stable")[-most:])


def folds_of(n: int, random_state: int, n_folds: int) -> Folds:
    """Folds of `n` rows."""
    return list(KFold(min(n_folds, n), shuffle=True, random_state=random_state).split(np.empty((n, 1))))


def boosting(rate: float, rounds: int, leaves: int, least: int, n: int, random_state: int) -> Maker:
    """A factory of untrained boosted trees, for `n` rows: more bins than rows change nothing and take time."""
    return lambda: HistGradientBoostingRegressor(
        learning_rate=rate,
        max_iter=rounds,
        max_leaf_nodes=leaves,
        min_samples_leaf=least,
        max_bins=min(n, 255),
        l2_regularization=1.0,
        max_features=0.5,
        early_stopping=False,
        random_state=random_state,
    )


def fit_out_of_fold(
    make: Maker, X: FloatArray, y: FloatArray, weight: FloatArray, folds: Folds
) -> tuple[FloatArray, Any]:
    """Out-of-fold predictions (n,), and a model of all rows."""

    def fitted(rows: Any) -> Any:
        # boosting takes several times as long with weights, equal ones too
        share = {"sample_weight": weight[rows]} if np.ptp(weight) else {}
        most = max(_MAX_COLUMNS, y[rows].size)
        model = make() if X.shape[1] <= most else _ScreeningRegressor(make(), most)
        return model.fit(X[rows], y[rows], **share)

    predictions = np.empty(y.size)
    for train, left_out in folds:
        predictions[left_out] = fitted(train).predict(X[left_out])
    return predictions, fitted(slice(None))
