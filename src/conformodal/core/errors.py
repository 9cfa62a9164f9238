"""The root of every error this package raises on purpose."""

from __future__ import annotations


class ConformodalError(ValueError):
    """Invalid input: what was found, where, and what was expected."""
