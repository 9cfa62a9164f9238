"""Joint regions of several targets that are no products: level sets of a joint density, calibrated."""

from __future__ import annotations

from copy import copy
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from conformodal.core.arrays import BoolArray, FloatArray

from .bins import QuantileBins
from .checks import Alpha, Probabilities, as_alpha, as_count, as_random, as_targets
from .errors import ConformalError, NotCalibratedError
from .predictive import PredictiveDensity
from .rank import conformal_quantile

# probabilities are kept so far from 0 and 1 that their normal quantiles are finite
_LEAST = 1e-4
# rows, per target, of no correlation that the estimate is mixed with
_PRIOR_ROWS = 5


class LevelSets:
    """Regions of n samples in d targets: values whose joint density is at least a level.

    :class:`LevelSetConformal` makes them. A set may be of any shape; it may fall apart.
    """

    def __init__(self, density: PredictiveDensity, correlation: FloatArray, level: float) -> None:
        self.density, self.correlation, self.level = density, correlation, level

    def __len__(self) -> int:
        return len(self.density)

    def contains(self, y: npt.ArrayLike, joint: bool = True) -> BoolArray:
        """Whether each set holds the values `y` (n, d) of all targets, (n,); `joint` must be True."""
        if not joint:
            raise ConformalError("joint must be True: level sets hold all targets together")
        values = as_targets(y, self.density.bins.n_targets)
        low, high = self.density.bins.limits.T
        within = ((low <= values) & (values <= high)).all(axis=1)
        return np.asarray((log_joint_density(self.density, self.correlation, values) >= self.level) & within)

    def log_volume(self, size: int = 500, random_state: Any = 0) -> FloatArray:
        """Logarithm of the volume of each set, (n,), from `size` draws of its density; inf where unbounded.

        The estimate of the volume is unbiased, of bounded variance: draws weigh at most one over the level.
        """
        random, total = as_random(random_state), np.zeros(len(self))
        if self.level == -np.inf:
            return np.full(len(self), np.log(np.diff(self.density.bins.limits)).sum())
        root = np.linalg.cholesky(self.correlation)
        for _ in range(as_count(size, "size", 1)):
            drawn = ndtr(random.normal(size=(len(self), len(root))) @ root.T)
            log = log_joint_density(self.density, self.correlation, self.density.quantiles(drawn))
            total += np.where(log >= self.level, np.exp(-np.maximum(log, self.level)), 0)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(total / size))


class LevelSetConformal:
    """Split conformal level sets of a joint density: predictive densities of the targets, joined by a Gaussian copula.

    If the calibration samples and a new sample are exchangeable, the set holds the values of all targets together with
    probability at least ``1 - alpha``, whatever the copula. ``ConformalRegressor(joint="density")`` uses it.

    Parameters
    ----------
    bins
        Fitted bins.
    alpha
        Miscoverage rate in (0, 1).

    Attributes
    ----------
    correlation_ : (d, d) of the copula; of no correlation until ``fit_copula`` is called
    scores_ : (n, 1) minus the log joint densities of the calibration samples
    thresholds_ : (1,)

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import LevelSetConformal, QuantileBins
    >>> rng = np.random.default_rng(0)
    >>> y = rng.normal(size=(600, 1)) + 0.1 * rng.normal(size=(600, 2))  # two targets, nearly the same
    >>> bins = QuantileBins(20, margin=0.1).fit(y[:200])
    >>> proba = np.full((400, 2, 20), 1 / 20)  # of a learner that has learnt nothing
    >>> for sets in (LevelSetConformal(bins), LevelSetConformal(bins).fit_copula(proba[:200], y[:200])):
    ...     regions = sets.calibrate(proba[:200], y[200:400]).predict(proba[:1])
    ...     print(f"volume {np.exp(regions.log_volume()[0]):.1f}")  # of a square, and along its diagonal
    volume 22.0
    volume 3.5
    """

    def __init__(self, bins: QuantileBins, alpha: Alpha = 0.1) -> None:
        as_alpha(alpha)
        self.bins, self.alpha = bins, alpha
        self.correlation_ = np.eye(bins.n_targets)

    def fit_copula(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Learn how the targets' errors depend on each other, from rows neither learnt from nor calibrated on."""
        normal = _normal_scores(PredictiveDensity(self.bins, proba), as_targets(y, self.bins.n_targets))
        n, prior = len(normal), _PRIOR_ROWS * self.bins.n_targets
        covariance = (normal.T @ normal + prior * np.eye(normal.shape[1])) / (n + prior)
        spread = np.sqrt(np.diag(covariance))
        self.correlation_ = covariance / spread / spread[:, None]
        return self

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Set the level from calibration samples: `proba` (n, d, K) or a list of d arrays, `y` (n, d)."""
        density = PredictiveDensity(self.bins, proba)
        self.scores_ = -log_joint_density(density, self.correlation_, as_targets(y, self.bins.n_targets))[:, None]
        self.thresholds_ = conformal_quantile(self.scores_, self.alpha)
        return self

    def predict(self, proba: Probabilities) -> LevelSets:
        """Regions of new samples."""
        if not hasattr(self, "thresholds_"):
            raise NotCalibratedError("LevelSetConformal is not calibrated yet: call calibrate first")
        return LevelSets(PredictiveDensity(self.bins, proba), self.correlation_, -float(self.thresholds_[0]))

    def at(self, alpha: Alpha) -> Self:
        """The same calibration at another miscoverage rate."""
        other = copy(self)
        other.alpha, other.thresholds_ = alpha, conformal_quantile(self.scores_, alpha)
        return other


def log_joint_density(density: PredictiveDensity, correlation: FloatArray, y: FloatArray) -> FloatArray:
    """Log density (n,) of values (n, d) of all targets; minus infinity outside the bins."""
    normal = _normal_scores(density, y)
    excess = np.linalg.inv(correlation) - np.eye(len(correlation))
    with np.errstate(divide="ignore"):
        marginal = np.log(density.pdf(y)).sum(axis=1)
    return np.asarray(marginal - 0.5 * (normal @ excess * normal).sum(axis=1) - 0.5 * np.linalg.slogdet(correlation)[1])


def _normal_scores(density: PredictiveDensity, y: FloatArray) -> FloatArray:
    return np.asarray(ndtri(np.clip(density.cdf(y), _LEAST, 1 - _LEAST)))
