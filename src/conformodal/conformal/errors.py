"""The error of what is used before it is fitted; by itself, as scikit-learn takes half a second to import."""

from __future__ import annotations

from sklearn.exceptions import NotFittedError

from conformodal.core.errors import ConformodalError


class NotCalibratedError(ConformodalError, NotFittedError):  # type: ignore[misc]
    """A calibrator such as :class:`SplitConformal`, or bins, used before they are fitted."""
