"""What can be wrong with pose sources and what they are given."""

from __future__ import annotations

from conformodal.conformal import ConformodalError


class LocalizationError(ConformodalError):
    """A pose source, a belief, or what they are made from cannot be used."""


class ReasoningError(ConformodalError):
    """Candidates, motions or timestamps that do not belong together."""
