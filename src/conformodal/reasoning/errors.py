"""Errors of the reasoning layer."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class ReasoningError(ConformodalError):
    """Candidates, motions or timestamps that do not belong together."""
