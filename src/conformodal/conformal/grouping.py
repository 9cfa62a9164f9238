"""Labels of groups and folds, in any container."""

from __future__ import annotations

from collections.abc import Hashable
from contextlib import suppress
from datetime import date
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, IntArray

from .checks import as_array, brief
from .errors import ConformalError


def as_groups(groups: npt.ArrayLike, n: int, name: str = "groups") -> AnyArray:
    """Labels (n,), one per sample.

    Strings, numbers, booleans, dates and tuples come in a list, an array or a pandas column, of objects or categories
    too; the same label is the same in all of them. Labels of mixed types stay objects. Missing labels (None, NaN, NaT,
    ``pandas.NA``, masked) and labels that are not hashable are refused.
    """
    # a list is read label by label: as an array its numbers could become text, and its tuples rows
    arr = _vector(list(groups)) if isinstance(groups, (list, tuple)) else as_array(groups, name)
    if arr.shape != (n,):
        raise ConformalError(f"{name} must have one label per sample, shape ({n},), got {arr.shape}")
    if arr.dtype.kind in "biuU":
        return arr.astype(arr.dtype.newbyteorder("="), copy=False)
    labels = []
    for row, label in enumerate(arr):
        try:
            labels.append(as_label(label))
        except ConformalError as exc:
            raise ConformalError(f"{name} must {exc}, in row {row}") from None
    packed = np.asarray(labels) if {type(label) for label in labels} in ({str}, {int}, {float}, {bool}) else None
    # an array of text forgets zeros at the end, and one of numbers may round
    if packed is not None and packed.dtype.kind in "biufU" and packed.tolist() == labels:
        return packed
    return _vector(labels)


def as_label(label: Any) -> Hashable:
    """A label as a plain Python object if possible: the same for all types that mean the same."""
    if isinstance(label, (date, np.datetime64)) and getattr(label, "tzinfo", None) is None:
        exact = getattr(label, "to_datetime64", None)  # of pandas, to the nanosecond
        label = np.datetime64(exact() if callable(exact) else label)
        with suppress(OverflowError):  # of far years
            micro = label.astype("M8[us]")
            label = None if np.isnat(label) else micro.item() if micro == label else label
    elif getattr(label, "ndim", None) == 0 and callable(getattr(label, "item", None)) and label is not np.ma.masked:
        label = label.item()
    if isinstance(label, tuple):
        label = tuple(as_label(part) for part in label)
    if is_missing(label):
        raise ConformalError(f"not hold NaN or another missing label, found {brief(label)}")
    try:
        hash(label)
    except TypeError:
        raise ConformalError(f"hold labels that are hashable, found a {type(label).__name__}") from None
    return label  # type: ignore[no-any-return]


def is_missing(value: Any) -> bool:
    """Whether a value stands for none: None, NaN, NaT, ``pandas.NA``, masked."""
    try:
        return value is None or value is np.ma.masked or bool(value != value)  # noqa: PLR0124 - NaN
    except Exception:  # pandas.NA has no truth value
        return True


def factorise(labels: AnyArray) -> tuple[list[Hashable], IntArray]:
    """Distinct labels, and for each sample (n,) the index of its own; sorted, or as they come if they cannot be."""
    if labels.dtype.kind != "O":
        values, codes = np.unique(labels, return_inverse=True)
        return values.tolist(), codes.astype(np.int64).reshape(labels.shape)
    place: dict[Hashable, int] = {}
    codes = np.array([place.setdefault(label, len(place)) for label in labels], dtype=np.int64)
    keys: list[Any] = list(place)
    try:
        order = sorted(range(len(keys)), key=keys.__getitem__)
    except (TypeError, ValueError):
        return keys, codes
    rank = np.empty(len(keys), dtype=np.int64)
    rank[order] = np.arange(len(keys))
    return [keys[i] for i in order], rank[codes]


def _vector(labels: list[Any]) -> npt.NDArray[np.object_]:
    arr = np.empty(len(labels), dtype=object)
    for i, label in enumerate(labels):  # at once, tuples would become rows
        arr[i] = label
    return arr
