"""Array types, and functions that select rows. Shapes are given where an array is described."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
UInt8Array: TypeAlias = npt.NDArray[np.uint8]
Float32Array: TypeAlias = npt.NDArray[np.float32]
AnyArray: TypeAlias = npt.NDArray[Any]
# float32 or float64
RealArray: TypeAlias = npt.NDArray[np.floating[Any]]


def evenly_spread(n: int, most: int) -> IntArray:
    """At most so many of n rows, in order: the first, the last and others evenly between."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def rows_by_label(labels: AnyArray) -> list[IntArray]:
    """Rows of each label, from the labels (n,) of all rows; by the order of the labels."""
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


class Rows:
    """A dataclass whose fields are arrays of as many rows."""

    __match_args__: ClassVar[tuple[str, ...]]  # names of the fields

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of one part after another."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__match_args__))

    def take(self, rows: IntArray | BoolArray | slice) -> Self:
        """Some of the rows, in the order of `rows`."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__match_args__))
