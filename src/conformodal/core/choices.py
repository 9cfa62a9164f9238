"""Arguments with a few possible values, brought into the enumeration that the code compares with."""

from __future__ import annotations

from enum import Enum
from typing import Any, TypeVar

from .errors import ConformodalError

Member = TypeVar("Member", bound=Enum)
_LONGEST = 80


def as_member(
    value: Any, choices: type[Member], argument: str, error: type[ConformodalError] = ConformodalError
) -> Member:
    """The member of an enumeration that a value stands for, or `error`, which names the argument.

    Examples
    --------
    >>> from enum import StrEnum
    >>> Colour = StrEnum("Colour", ["RED", "BLUE"])
    >>> as_member("red", Colour, "colour") is Colour.RED
    True
    >>> as_member("pink", Colour, "colour")
    Traceback (most recent call last):
    conformodal.core.errors.ConformodalError: colour must be one of red, blue, got 'pink'
    """
    try:
        return choices(value)
    except (ValueError, TypeError):
        names = ", ".join(str(member.value) for member in choices)
        raise error(f"{argument} must be one of {names}, got {' '.join(repr(value).split())[:_LONGEST]}") from None
