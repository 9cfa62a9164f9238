"""What arrays and JSON of a saved file must be: tables, against which a reader checks them once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from .arrays import AnyArray
from .errors import ConformodalError
from .ranges import Range

_MOST = np.float32(1e9)  # in size: products of larger numbers leave single precision

VALUES: dict[str, Callable[[AnyArray], Any]] = {
    "anything": lambda a: True,
    "finite": lambda a: (np.abs(a) <= _MOST).all(),  # False for NaN
    "finite or NaN": lambda a: (np.isnan(a) | (np.abs(a) <= _MOST)).all(),
    "positive": lambda a: ((a > 0) & (a <= _MOST)).all(),
    "finite or infinite": lambda a: (np.isinf(a) | (np.abs(a) <= _MOST)).all(),
    "probabilities or NaN": lambda a: (np.isnan(a) | ((a >= 0) & (a <= 1))).all(),
    "increasing": lambda a: (np.abs(a) <= _MOST).all() and (np.diff(a) > 0).all(),
    "not all zero": lambda a: (np.abs(a) <= _MOST).all() and a.any(),
}


class ArraySpec(NamedTuple):
    """What an array must be."""

    dtypes: str  # the characters of those that it may have, as NumPy has them
    # a name stands for one size in all of a schema, at least 1, or 0 if it ends in "?"
    shape: tuple[int | str, ...]
    values: str = "finite"  # one of :data:`VALUES`
    below: str = ""  # the size that all values are below, and none is negative, of indices


ArraySchema = Mapping[str, ArraySpec]


def check_arrays(arrays: Mapping[str, AnyArray], schema: ArraySchema, sizes: dict[str, int]) -> None:
    """Refuse arrays that the schema does not have, or has otherwise; some of it may be missing.

    `sizes` are those known, and get the others.
    """
    for name in arrays.keys() - schema.keys():
        raise ConformodalError(f"array {name} is not one of those expected")
    given_by: dict[str, str] = {}  # the array that gave a size, by its name
    for name, spec in schema.items():
        if name not in arrays:
            continue
        array = arrays[name]
        got = f"array {name} is {array.dtype} {array.shape}"
        if array.dtype.char not in spec.dtypes or array.ndim != len(spec.shape):
            raise ConformodalError(f"{got}, expected {'/'.join(spec.dtypes)} {_named(spec)}")
        for size, expected in zip(array.shape, spec.shape, strict=True):
            if isinstance(expected, str) and expected not in sizes:
                sizes[expected], given_by[expected] = size, f" as in array {name}"
            fixed = sizes[expected] if isinstance(expected, str) else expected
            if size != fixed or (size == 0 and not str(expected).endswith("?")):
                of = given_by.get(str(expected), "")
                raise ConformodalError(f"{got}, expected {_named(spec)} with {expected} = {fixed or 'at least 1'}{of}")
        if not VALUES[spec.values](array):
            raise ConformodalError(f"array {name} must be {spec.values}")
        below = sizes.get(spec.below, np.inf)
        if spec.below and array.size and not 0 <= array.min() <= array.max() < below:
            raise ConformodalError(
                f"array {name} must hold indices below {spec.below} = {below}{given_by.get(spec.below, '')}"
            )


def _named(spec: ArraySpec) -> str:
    return f"({', '.join(map(str, spec.shape))})"


class ListOf(NamedTuple):
    """A list in JSON of any length, at least `least`."""

    of: Any
    least: int = 1


def check_json(value: Any, expected: Any, name: str) -> None:
    """Refuse JSON that is not what is expected.

    That is a range for a number; a class for a value of it; an enumeration for one of its values; a list for one of as
    many entries; :class:`ListOf`; a dictionary for one with these keys, or with others as well if it has ``...``; a set
    of values for one of them; and a tuple of None and something else for either of them.
    """
    if isinstance(expected, tuple) and not isinstance(expected, Range | ListOf):
        if value is not None:
            check_json(value, expected[1], name)
    elif isinstance(expected, dict):
        keys = value.keys() if isinstance(value, dict) else set()
        wrong = {*expected} - {...} - keys if ... in expected else {*expected} ^ keys
        if wrong or not isinstance(value, dict):
            raise ConformodalError(f"{name} must have the keys {', '.join(k for k in expected if k is not ...)}")
        for key in keys & expected.keys():
            check_json(value[key], expected[key], f"{name}.{key}")
    elif isinstance(expected, list | ListOf):
        is_list, least = isinstance(value, list), expected.least if isinstance(expected, ListOf) else len(expected)
        if not is_list or len(value) < least or (isinstance(expected, list) and len(value) > least):
            raise ConformodalError(f"{name} must be a list of at least {least}, got {str(value)[:80]}")
        for i, entry in enumerate(value):
            check_json(entry, expected.of if isinstance(expected, ListOf) else expected[i], f"{name}.{i}")
    elif not _holds(value, expected):
        stated = expected.__name__ if isinstance(expected, type) else expected
        raise ConformodalError(f"{name} must be {stated}, got {str(value)[:80]}")


def _holds(value: Any, expected: Any) -> bool:
    if isinstance(expected, Range):
        return expected.holds(value)
    if isinstance(expected, type) and not issubclass(expected, StrEnum):
        return isinstance(value, expected)
    return isinstance(value, str) and value in {*expected}
