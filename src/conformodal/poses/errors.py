"""Errors of the poses floor."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class PoseError(ConformodalError):
    """A pose, rotation or trajectory that is none: NaN, a matrix that is no rotation, lengths that differ."""


class TrajectoryFileError(PoseError):
    """A trajectory file that cannot be read as what it should be; names the file and line."""
