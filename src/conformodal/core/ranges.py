"""Values that settings may have: ranges, and members of enumerations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeVar

from .errors import ConformodalError

Member = TypeVar("Member", bound=Enum)


class Range(NamedTuple):
    """Finite numbers between two ends, which count unless their bracket is round."""

    low: float
    high: float = math.inf
    ends: str = "[]"
    whole: bool = False

    def holds(self, value: Any) -> bool:
        """Whether a value is a number of it."""
        if isinstance(value, bool) or not isinstance(value, Integral if self.whole else Real):
            return False
        number: Any = value
        low, high = number > self.low or "[" in self.ends, number < self.high or "]" in self.ends
        return bool(self.low <= number <= self.high and low and high and number < math.inf)

    def __str__(self) -> str:
        kind = "a whole number" if self.whole else "a finite number"
        return f"{kind} in {self.ends[0]}{self.low:g}, {self.high:.10g}{self.ends[1]}"


RANGES = {
    # probabilities of a thousand samples over the most bins take 0.8 GB
    "n_bins": Range(1, 100_000, whole=True),
    "sigma_bins": Range(0, 10_000),
    "epochs": Range(1, 1_000_000, whole=True),
    "batch_size": Range(1, whole=True),
    "learning_rate": Range(0, ends="(]"),
    "dropout": Range(0, 0.95),
    "test": Range(0, 1, "()"),
    "calibration": Range(0, 1, "()"),
    "used": Range(0, 1, "(]"),
    "novelty_level": Range(0, 1, "[)"),
    "seed": Range(0, 2**31 - 1, whole=True),
}


def check_ranges(settings: Mapping[str, Any], error: type[ConformodalError]) -> None:
    """Raise `error` for the first setting that is out of its range; None and settings without a range pass."""
    for name, value in settings.items():
        if name in RANGES and value is not None and not RANGES[name].holds(value):
            raise error(f"{name} must be {RANGES[name]}, got {value!r}")


def check_shares(test: float, calibration: float, used: float | None, error: type[ConformodalError]) -> None:
    """Raise `error` for shares of frames that leave nothing to train on."""
    if test + calibration >= 1:
        raise error(f"test and calibration must leave something to train on, got {test} and {calibration}")
    if used is not None and not calibration < used <= 1 - test + 1e-9:
        raise error(f"used must be above calibration ({calibration}) and leave test ({test}), got {used}")


def as_member(
    value: Any, choices: type[Member], argument: str, error: type[ConformodalError] = ConformodalError
) -> Member:
    """The member of an enumeration that a value stands for, or `error`, which names the argument."""
    try:
        return choices(value)
    except (ValueError, TypeError):
        names = ", ".join(str(member.value) for member in choices)
        raise error(f"{argument} must be one of {names}, got {value!r}") from None
