"""Errors and warnings of :mod:`conformodal.conformal`."""

from __future__ import annotations

from conformodal.core.errors import ConformodalError

__all__ = ["ConformodalError"]


class ConformalError(ConformodalError):
    """Raised by :mod:`conformodal.conformal`: probabilities, targets, alpha or bins that cannot be used.

    Examples
    --------
    >>> from conformodal.conformal import ConformalError, conformal_rank
    >>> try:
    ...     conformal_rank(99, alpha=1.5)
    ... except ConformalError as error:
    ...     print(error)
    alpha must lie strictly between 0 and 1 (a miscoverage rate), got 1.5; did you mean 0.015?
    """


class ConformalTypeError(ConformalError, TypeError):
    """For sparse matrices and objects, which scikit-learn expects a ``TypeError`` for."""


class NotCalibratedError(ConformalError):
    """A calibrator, or bins, used before they are fitted.

    Examples
    --------
    >>> from conformodal.conformal import NotCalibratedError, QuantileBins, SplitConformal
    >>> try:
    ...     SplitConformal(QuantileBins.from_edges([[0, 1]])).predict([[1.0]])
    ... except NotCalibratedError as error:
    ...     print(error)
    SplitConformal is not calibrated yet: call calibrate first
    """


class SlowFitWarning(UserWarning):
    """A fit that will take more than ten seconds; estimates the time and names a faster estimator.

    Examples
    --------
    >>> import warnings
    >>> from conformodal.conformal import SlowFitWarning
    >>> warnings.simplefilter("ignore", SlowFitWarning)  # if you accept the wait
    """


class WholeRangeWarning(UserWarning):
    """The threshold is the worst possible score, so that every set holds every bin.

    This happens if more than alpha of the calibration rows lie in bins of probability 0.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> from conformodal.conformal import QuantileBins, SplitConformal, WholeRangeWarning
    >>> bins = QuantileBins.from_edges([[0, 1, 2]])
    >>> proba, y = np.tile([1.0, 0.0], (40, 1)), np.tile([0.5, 1.5], 20)
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     calibrator = SplitConformal(bins, alpha=0.1).calibrate(proba, y)
    >>> caught[0].category is WholeRangeWarning
    True
    """
