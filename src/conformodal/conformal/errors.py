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
    """A calibrator such as :class:`SplitConformal`, or bins, used before they are fitted."""


class SlowFitWarning(UserWarning):
    """A fit, of a :class:`ConformalRegressor`, of more than ten seconds; names a faster estimator."""


class WholeRangeWarning(UserWarning):
    """The threshold is the worst possible score, so that every set holds every bin.

    This happens if more than alpha of the calibration rows lie in bins of probability 0. :class:`ConformalRegressor`
    smooths the probabilities, so that none is 0.
    """
