"""Checks of single values: rates, integers, real numbers, names and seeds."""

from __future__ import annotations

import operator
from collections.abc import Callable
from contextlib import suppress
from decimal import Decimal
from fractions import Fraction
from numbers import Rational, Real
from typing import Any, TypeAlias, get_args

import numpy as np

from .errors import ConformalError

Alpha: TypeAlias = float | str | Decimal | Fraction

# powers of ten beyond which a decimal is not a rate, and would take long to read
_MOST_DIGITS = 400
_LONGEST_REPR = 80


def brief(value: object) -> str:
    """`value` as errors show it, on one line."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever a foreign class raises
        text = f"<{type(value).__name__}>"
    return shortened(text, _LONGEST_REPR)


def shortened(text: str, most: int = 300) -> str:
    """`text` without its middle if it is longer than `most`."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def as_alpha(alpha: Alpha) -> Fraction:
    """A miscoverage rate as the decimal it is written as: ``0.1`` is one tenth, not 0.1000000000000000055."""
    try:
        if isinstance(alpha, bool):
            raise TypeError
        value = Fraction(alpha) if isinstance(alpha, Rational) else _as_decimal(str(alpha))
    except (ValueError, TypeError, OverflowError, ZeroDivisionError):
        raise ConformalError(f"alpha must be a number strictly between 0 and 1, got {brief(alpha)}") from None
    if not 0 < value < 1:
        percent = float(value) / 100  # a miscoverage, or, if it is more than half, a coverage
        hint = f"; did you mean {min(percent, 1 - percent):g}?" if 1 < value < 100 else ""
        found = brief(str(alpha)).strip("'")
        raise ConformalError(f"alpha must lie strictly between 0 and 1 (a miscoverage rate), got {found}{hint}")
    return value


def _as_decimal(text: str) -> Fraction:
    power = text.lower().partition("e")[2]
    if power and abs(int(power)) > _MOST_DIGITS:
        raise ValueError
    return Fraction(text)


def as_count(value: Any, name: str, least: int = 0, most: int | None = None) -> int:
    """An integer of at least `least` and at most `most`; booleans and floats are refused."""
    try:
        if isinstance(value, (bool, np.bool_)):
            raise TypeError
        number = operator.index(value)
    except Exception:  # whatever a foreign class raises
        raise ConformalError(f"{name} must be a whole number, at least {least}, got {brief(value)}") from None
    if number < least or (most is not None and number > most):
        end = "" if most is None else f" and at most {most}"
        raise ConformalError(f"{name} must be a whole number, at least {least}{end}, got {number}")
    return number


def as_number(value: Any, name: str, expected: str, holds: Callable[[float], bool]) -> float:
    """A real number for which `holds`; `expected` describes it in messages."""
    if isinstance(value, np.ndarray) and value.ndim == 0 and not isinstance(value, np.ma.MaskedArray):
        value = value[()]
    number = float("nan")
    if isinstance(value, (Real, Decimal)) and not isinstance(value, bool):
        with suppress(OverflowError, ValueError):
            number = float(value)
    if not holds(number):
        raise ConformalError(f"{name} must be {expected}, got {brief(value)}")
    return number


def as_choice(value: Any, options: Any, name: str) -> None:
    """Check a name against a ``Literal``."""
    if not isinstance(value, str) or value not in get_args(options):
        raise ConformalError(f"{name} must be one of {list(get_args(options))}, got {brief(value)}")


def as_random(random_state: Any) -> np.random.RandomState:
    """The random numbers of a seed, a ``RandomState`` or None, as in scikit-learn."""
    from sklearn.utils import check_random_state  # noqa: PLC0415 - a second to import

    try:
        found: np.random.RandomState = check_random_state(random_state)
        return found
    except (ValueError, TypeError):
        raise ConformalError(f"random_state must be a seed, a RandomState or None, got {brief(random_state)}") from None
