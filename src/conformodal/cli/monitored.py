"""What ``conformodal monitor`` watches, of runs and of tables alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from conformodal.core.arrays import FloatArray

_MOST_NAMED = 3


@dataclass(frozen=True, eq=False)
class MonitoredScores:
    """Scores of new units in the order in which they came, and of those that calibrate."""

    noun: str  # what a unit is, and
    plural: str
    quantity: str  # what the scores tell of
    columns: list[str]  # names of the c columns of scores, each monitored by itself
    before: FloatArray  # (n, c)
    new: FloatArray  # (m, c)
    names: list[str]  # (m,) of the new units
    groups: Any = None  # (n,) labels within which scores are exchangeable, and (m,) of the new
    new_groups: Any = None
    larger_only: bool = True  # whether only larger scores raise an alarm
    limits: Sequence[str] = ()  # what the result does not say


def named_few(names: Sequence[str]) -> str:
    """The first few of some names, and how many more there are."""
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more
