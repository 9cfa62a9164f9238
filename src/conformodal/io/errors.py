"""Errors of the datasets layer."""

from __future__ import annotations

import re

from conformodal.conformal import ConformodalError
from conformodal.conformal.checks import shortened

_BREAK = re.compile(r"\s*[\r\n]\s*")
_MOST = 2000  # characters of a message


class DatasetError(ConformodalError):
    """A folder, pose file or intrinsics file that does not follow its layout; names the file."""

    def __init__(self, message: str = "") -> None:  # hostile names would fill the screen
        super().__init__(shortened(_BREAK.sub(" ", message), _MOST))


class ImageError(DatasetError):
    """An image that is missing, truncated, or no image; names the file."""


class SplitError(DatasetError):
    """Parts of a data set that cannot be formed as asked."""


class DatasetWarning(UserWarning):
    """Something in a data set that was left out or looks wrong; what remains is sound."""
