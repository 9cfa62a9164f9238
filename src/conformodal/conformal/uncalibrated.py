"""The error for what is used before it is fitted or calibrated."""

from sklearn.exceptions import NotFittedError

from conformodal.core.errors import ConformodalError


class NotCalibratedError(ConformodalError, NotFittedError):  # type: ignore[misc]
    """A calibrator such as :class:`SplitConformal`, or bins, used before they are fitted."""
