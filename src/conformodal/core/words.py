"""Counts and lists in sentences; text and numbers as files hold them."""

from __future__ import annotations

import math
from collections.abc import Sequence


def counted(n: int, noun: str, plural: str | None = None) -> str:
    """A number with its noun, whose plural ends in s unless it is given."""
    return f"{n} {noun_for(n, noun, plural)}"


def noun_for(n: int, noun: str, plural: str | None = None) -> str:
    """The noun alone, or another word that depends on a number: ``noun_for(n, "is", "are")``."""
    return noun if n == 1 else plural or f"{noun}s"


def listed(words: Sequence[str]) -> str:
    """Words as a sentence lists them, at least one."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def readable(value: float) -> str:
    """A number with four digits or, from 10,000 on, its whole part: up to a billion without an exponent."""
    return f"{value:,.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def length(value: float, unit: str, digits: int = 3) -> str:
    """A length in its unit, ``m`` or ``units`` of the data's own."""
    return f"{value:.{digits}f} {unit}"


def as_utf8(text: str) -> str:
    """Text without what UTF-8 cannot encode: undecodable bytes of a file name become backslashes and digits."""
    return text.encode("utf-8", "backslashreplace").decode()


def finite_or_none(value: float) -> float | None:
    """The number; None where it is infinite or NaN, which JSON does not have."""
    return float(value) if math.isfinite(value) else None


def describe_format(stated: object, expected: str, again: str) -> str:
    """What to do about a file in another format than is read, ``NAME-NUMBER``: of a newer version, or `again` it."""
    kind, _, number = expected.rpartition("-")
    name, _, other = str(stated).rpartition("-")
    if name == kind and other.isdecimal() and len(other) < 10 and int(other) > int(number):
        what = "it was saved by a newer version; update conformodal (pip install --upgrade conformodal)"
        return f"holds format {stated!r}, and this version reads {expected!r}: {what}"
    return f"holds format {str(stated)[:80]!r}, expected {expected!r}. {again}"
