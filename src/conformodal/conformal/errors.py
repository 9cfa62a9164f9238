"""Errors of the conformal core."""

from __future__ import annotations

from conformodal.core.errors import ConformodalError

__all__ = ["ConformalError", "ConformalTypeError", "ConformodalError", "NotCalibratedError", "SlowFitWarning"]


class ConformalError(ConformodalError):
    """Raised by :mod:`conformodal.conformal`: probabilities, targets, alpha or bins that cannot be used."""


class ConformalTypeError(ConformalError, TypeError):
    """What scikit-learn wants told as a ``TypeError``: sparse matrices, and objects that are no numbers."""


class NotCalibratedError(ConformalError):
    """A prediction was asked of a calibrator (or bins) that has not been fitted yet."""


class SlowFitWarning(UserWarning):
    """A fit that will take more than ten seconds; says about how many, and what is quicker."""
