"""Errors of the vision floor."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class VisionError(ConformodalError):
    """A backbone, feature or training setting that cannot be used."""
