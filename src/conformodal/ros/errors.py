"""Errors of what speaks to robots."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class RosError(ConformodalError):
    """Something that cannot be said in ROS, or a recording that cannot be written; names what, and what is expected."""
