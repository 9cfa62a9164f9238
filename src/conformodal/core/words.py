"""Counts and lists in sentences."""

from __future__ import annotations

from collections.abc import Sequence


def counted(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun, whose plural ends in s unless it is given.

    Examples
    --------
    >>> counted(1, "frame"), counted(2, "frame"), counted(0, "stretch", "stretches")
    ('1 frame', '2 frames', '0 stretches')
    """
    return f"{n} {noun_for(n, noun, plural)}"


def noun_for(n: int, noun: str, plural: str | None = None) -> str:
    """The noun alone, or another word that depends on a number: ``noun_for(n, "is", "are")``."""
    return noun if n == 1 else plural or f"{noun}s"


def listed(words: Sequence[str]) -> str:
    """Words as a sentence lists them, at least one.

    Examples
    --------
    >>> listed(["x"]), listed(["x", "y"]), listed(["x", "y", "z"])
    ('x', 'x and y', 'x, y and z')
    """
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
