"""Doubts about rows: new ones unlike those learnt from, and ones whose coverage is not that of later rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.stats import binom

from conformodal.core.arrays import BoolArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .density.encoder import column_of, columns_of, has_zone, is_frame

Unlike = Literal["unbounded", "ignore"]

# what is no more likely than this, if new rows are like the training rows, is told
_CHANCE = 1e-3
_FAR = 10.0  # ranges beyond a range: another unit


class DataWarning(UserWarning):
    """Rows that are unlike each other in a way that coverage does not hold for, and what to do."""


@dataclass
class ColumnMemory:
    """What one column held: rows, rows without a value, the range of numbers, or how often each label occurred."""

    n: int = 0
    n_missing: int = 0
    low: float = np.inf
    high: float = -np.inf
    labels: dict[str, int] = field(default_factory=dict)

    def learn(self, values: Any) -> None:
        """Take in more rows of the column."""
        present = values[~_missing(values)]
        self.n, self.n_missing = self.n + len(values), self.n_missing + len(values) - len(present)
        if values.dtype.kind == "f":
            self.low, self.high = present.min(initial=self.low), present.max(initial=self.high)
            self.low, self.high = float(self.low), float(self.high)
        else:
            for label, count in zip(*np.unique(present, return_counts=True), strict=True):
                self.labels[str(label)] = self.labels.get(str(label), 0) + int(count)

    def compare(self, values: Any, name: object) -> tuple[BoolArray, list[str]]:
        """Whether each value is of a kind that never occurred, and what is not chance, in words."""
        gaps, m, words = _missing(values), len(values), list[str]()
        unlike = gaps & (self.n_missing == 0)
        if self.n_missing == self.n or (values.dtype.kind == "f" and self.labels):
            return unlike & False, words
        if unlike.any() or binom.sf(gaps.sum() - 1, m, self.n_missing / self.n) < _CHANCE:
            words.append(f"{name} is missing in {gaps.sum()}, in training in {self.n_missing} of {self.n}")
        if values.dtype.kind == "f":
            outside = ~gaps & ((values < self.low) | (values > self.high))
            far = np.abs(values - (self.low + self.high) / 2) > _FAR * (self.high - self.low)
            if (outside & far).any() or binom.sf(outside.sum() - 1, m, 2 / (self.n + 1)) < _CHANCE**2:
                words.append(f"{name} is beyond {self.low:.6g} to {self.high:.6g}, its range, in {outside.sum()}")
            return unlike, words
        new = ~gaps & ~np.isin(values, list(self.labels))
        once = sum(count == 1 for count in self.labels.values())  # of n: the chance of a new label (Good 1953)
        if new.any() and binom.sf(new.sum() - 1, m, once / self.n) < _CHANCE:
            label = str(values[new][0])
            same = [old for old in self.labels if old.strip().casefold() == label.strip().casefold()]
            hint = f", which may be {same[0]!r}" if same else ""
            words.append(f"{name} has a label that is new in {new.sum()}, such as {label!r}{hint}")
        return unlike | (new & (once == 0)), words


class TableMemory:
    """What the columns of a table held, to tell new rows that are unlike its rows."""

    def __init__(self) -> None:
        self.columns: list[ColumnMemory] = []
        self.zones: list[bool] = []

    def learn(self, X: Any) -> None:
        """Take in the rows of a table; what is not a table of numbers, text and dates is passed over."""
        columns = _columns(X)
        self.columns = self.columns or [ColumnMemory() for _ in columns]
        for memory, values in zip(self.columns, columns, strict=len(columns) > 0):
            memory.learn(values)
        self.zones = _zones(X)

    def compare(self, X: Any) -> tuple[BoolArray, str]:
        """Rows (n,) with a label, or a missing value, where none occurred, and a warning or nothing."""
        unlike, words = np.zeros(X.shape[0], dtype=np.bool_), list[str]()
        texts = [j for j, memory in enumerate(self.columns) if memory.labels]
        for j, (memory, values) in enumerate(zip(self.columns, _columns(X, texts), strict=False)):
            rows, told = memory.compare(values, X.columns[j] if is_frame(X) else f"column {j}")
            unlike, words = unlike | rows, words + told
        for j, (before, now) in enumerate(zip(self.zones, _zones(X), strict=False)):
            if before != now:
                words.append(f"{X.columns[j]} had {'a' if before else 'no'} time zone in training")
        if not words:
            return unlike, ""
        return unlike, f"of {counted(len(unlike), 'row')}: {'; '.join(words)}"


def _zones(X: Any) -> list[bool]:
    return [has_zone(column_of(X, j)) for j in range(X.shape[1])] if is_frame(X) else []


def _missing(values: Any) -> BoolArray:
    return np.asarray(np.isnan(values) if values.dtype.kind == "f" else values == "")


def _columns(X: Any, text: Any = ()) -> list[Any]:
    try:
        return [] if hasattr(X, "tocsr") else columns_of(X, text)
    except (ConformodalError, ValueError, TypeError):
        return []
