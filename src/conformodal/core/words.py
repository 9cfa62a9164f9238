"""Counts in sentences."""

from __future__ import annotations


def counted(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun: ``1 frame``, ``2 frames``.

    Parameters
    ----------
    n
        How many.
    noun
        Of one.
    plural
        Of several; by default the noun with an s.

    Examples
    --------
    >>> counted(1, "frame"), counted(2, "frame"), counted(0, "stretch", "stretches")
    ('1 frame', '2 frames', '0 stretches')
    """
    return f"{n} {noun_for(n, noun, plural)}"


def noun_for(n: int, noun: str, plural: str | None = None) -> str:
    """The noun alone, or another word that a count changes: ``noun_for(n, "is", "are")``.

    Parameters
    ----------
    n, noun, plural
        As for :func:`counted`.
    """
    return noun if n == 1 else plural or f"{noun}s"
