"""Errors of poses and trajectories."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class PoseError(ConformodalError):
    """An invalid pose, rotation or trajectory: NaN, not a rotation, different lengths."""


class TrajectoryFileError(PoseError):
    """A trajectory file that cannot be read; names the file and the line."""
