"""Errors and warnings of :mod:`conformodal.conformal`; the one for what is not fitted imports scikit-learn late."""

from __future__ import annotations

from conformodal.core.errors import ConformodalError

__all__ = ["ConformodalError"]


class ConformodalTypeError(ConformodalError, TypeError):
    """For sparse matrices and objects, which scikit-learn expects a ``TypeError`` for."""


def not_calibrated(message: str) -> ConformodalError:
    """A ``NotCalibratedError``, to be raised."""
    from .uncalibrated import NotCalibratedError  # noqa: PLC0415 - scikit-learn takes half a second to import

    return NotCalibratedError(message)


class SlowFitWarning(UserWarning):
    """A fit, of a :class:`ConformalRegressor`, of more than ten seconds; names a faster estimator."""


class WholeRangeWarning(UserWarning):
    """The threshold is the worst possible score, so that every set holds every bin.

    This happens if more than alpha of the calibration rows lie in bins of probability 0. :class:`ConformalRegressor`
    smooths the probabilities, so that none is 0.
    """
