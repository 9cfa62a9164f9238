"""Errors of the datasets floor."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class DatasetError(ConformodalError):
    """A folder, pose file or intrinsics file that is not what its layout promises; names the file."""


class ImageError(DatasetError):
    """An image that is missing, truncated, or no image; names the file."""


class SplitError(DatasetError):
    """Parts of a data set that cannot be formed as asked."""


class DatasetWarning(UserWarning):
    """Something in a data set that was left out or looks wrong; what remains is sound."""
