"""Errors of the io package."""

from __future__ import annotations

import re

from conformodal.core.errors import ConformodalError

_BREAK = re.compile(r"\s*[\r\n]\s*")
_MOST = 2000  # characters of a message: hostile names would fill the screen


class DatasetError(ConformodalError):
    """A folder, pose file or intrinsics file that does not follow its layout; names the file."""

    def __init__(self, message: str = "") -> None:
        super().__init__(_BREAK.sub(" ", message)[:_MOST])


class ImageError(DatasetError):
    """An image that is missing, truncated, or not an image; names the file."""


class SplitError(DatasetError):
    """Parts of a data set that cannot be formed as asked."""


class DatasetWarning(UserWarning):
    """Something in a data set that was left out or looks wrong; what remains is sound."""
