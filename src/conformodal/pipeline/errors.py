"""Errors of models, their files, and results."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class ModelFileError(ConformodalError):
    """A saved model that is missing, incomplete, of another version, or not as it was saved; names the file."""


class OdometryError(ConformodalError):
    """Frames, parts or results that a model cannot work with."""


class ResultsError(ConformodalError):
    """A folder of results that is missing something or cannot be read; names the file."""
