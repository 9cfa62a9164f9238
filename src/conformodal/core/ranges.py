"""Values that settings may have, for the Python interface and the command line: ranges, and members of enumerations."""

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


def _whole(low: int, high: float = math.inf) -> Range:
    return Range(low, high, whole=True)


_SHARE = Range(0, 1, low_open=True, high_open=True)
_POSITIVE = Range(0, low_open=True)
_MANY = 1_000_000
RANGES = {
    # probabilities of a thousand samples over the most bins take 0.8 GB
    "n_bins": _whole(1, 100_000),
    "sigma_bins": Range(0, 10_000),
    "epochs": _whole(1, _MANY),
    "batch_size": _whole(1),
    "learning_rate": _POSITIVE,
    "dropout": Range(0, 0.95),
    "test": _SHARE,
    "calibration": _SHARE,
    "used": Range(0, 1, low_open=True),
    "novelty_level": Range(0, 1, high_open=True),
    "seed": _whole(0, 2**31 - 1),
    "n_blocks": _whole(1),
    "seeds": _whole(1, 10_000),
    "first_seed": _whole(0, 2**30),
    "workers": _whole(1, 1024),
    "limit": _whole(1),
    "metres_per_radian": _POSITIVE,
    "max_gap": Range(0),
}


def check_ranges(settings: Mapping[str, Any], error: type[ConformodalError]) -> None:
    """Raise `error` for the first setting that is out of its range; None and settings without a range pass."""
    for name, value in settings.items():
        allowed = RANGES.get(name)
        if allowed is not None and value is not None and not allowed.holds(value):
            raise error(f"{name} must be {allowed}, got {value!r}")


def check_shares(
    test: float,
    calibration: float,
    used: float | None,
    error: type[ConformodalError],
    names: tuple[str, str, str] = ("test", "calibration", "used"),
) -> None:
    """Raise `error` for shares of frames that leave nothing to train on; `names` are for the message."""
    if test + calibration >= 1:
        raise error(f"{names[0]} and {names[1]} must leave something to train on, got {test} and {calibration}")
    if used is not None and not calibration < used <= 1 - test + 1e-9:
        raise error(
            f"{names[2]} must be more than {names[1]} ({calibration}) and at most what {names[0]} ({test}) leaves, "
            f"got {used}"
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
