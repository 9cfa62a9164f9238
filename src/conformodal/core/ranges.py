"""Values that settings may have: ranges, and members of enumerations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from numbers import Integral, Real
from typing import Any, TypeVar

from .errors import ConformodalError

Member = TypeVar("Member", bound=Enum)
_LONGEST = 80  # characters of a refused value that a message repeats


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`; the ends count unless they are open."""

    low: float
    high: float = math.inf
    low_open: bool = False
    high_open: bool = False
    whole: bool = False

    def holds(self, value: Any) -> bool:
        """Whether a value is a finite number of it."""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        number: Any = value
        above = number > self.low if self.low_open else number >= self.low
        below = number < self.high if self.high_open else number <= self.high
        return bool(above and below and number < math.inf)

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a finite number"
        low = f"{kind}, {'more than' if self.low_open else 'at least'} {self.low:g}"
        if math.isinf(self.high):
            return low
        return f"{low} and {'less than' if self.high_open else 'at most'} {f'{self.high:.10g}'}"


_SHARE = Range(0, 1, low_open=True, high_open=True)
RANGES = {
    # probabilities of a thousand samples over the most bins take 0.8 GB
    "n_bins": Range(1, 100_000, whole=True),
    "sigma_bins": Range(0, 10_000),
    "epochs": Range(1, 1_000_000, whole=True),
    "batch_size": Range(1, whole=True),
    "learning_rate": Range(0, low_open=True),
    "dropout": Range(0, 0.95),
    "test": _SHARE,
    "calibration": _SHARE,
    "used": Range(0, 1, low_open=True),
    "novelty_level": Range(0, 1, high_open=True),
    "seed": Range(0, 2**31 - 1, whole=True),
    "n_blocks": Range(1, whole=True),
}


def check_ranges(settings: Mapping[str, Any], error: type[ConformodalError]) -> None:
    """Raise `error` for the first setting that is out of its range; None and settings without a range pass."""
    for name, value in settings.items():
        allowed = RANGES.get(name)
        if allowed is not None and value is not None and not allowed.holds(value):
            raise error(f"{name} must be {allowed}, got {value!r}")


def check_shares(test: float, calibration: float, used: float | None, error: type[ConformodalError]) -> None:
    """Raise `error` for shares of frames that leave nothing to train on."""
    if test + calibration >= 1:
        raise error(f"test and calibration must leave something to train on, got {test} and {calibration}")
    if used is not None and not calibration < used <= 1 - test + 1e-9:
        raise error(
            f"used must be more than calibration ({calibration}) and at most what test ({test}) leaves, got {used}"
        )


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
