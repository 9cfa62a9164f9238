"""Labels of groups and folds, in any container."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from datetime import date, datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import IntArray

from .checks import as_array
from .errors import ConformalError
from .scalars import brief


def as_groups(groups: npt.ArrayLike, n: int, name: str = "groups") -> npt.NDArray[Any]:
    """Labels (n,), one per sample.

    Strings, numbers, booleans, dates and tuples come in a list, an array or a pandas column, of objects or categories
    too; the same label is the same in all of them. Labels of mixed types stay objects. Missing labels (None, NaN, NaT,
    ``pandas.NA``, masked) and labels that are not hashable are refused.
    """
    # a list is read label by label: as an array its numbers could become text, and its tuples rows
    arr = _vector(groups) if isinstance(groups, (list, tuple)) else as_array(groups, name)
    if arr.shape != (n,):
        raise ConformalError(f"{name} must have one label per sample, shape ({n},), got {arr.shape}")
    if arr.dtype.kind == "f" and not np.isnan(arr).any():
        return arr.astype(np.float64, copy=False)
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
    if callable(getattr(label, "to_datetime64", None)) and getattr(label, "tzinfo", None) is None:
        label = label.to_datetime64()  # a time of pandas, to the nanosecond
    elif callable(getattr(label, "to_timedelta64", None)):
        label = label.to_timedelta64()
    elif isinstance(label, date) and not isinstance(label, datetime):
        label = datetime(label.year, label.month, label.day)
    if isinstance(label, (np.datetime64, np.timedelta64)):
        label = _as_time(label)
    elif getattr(label, "ndim", None) == 0 and callable(getattr(label, "item", None)) and label is not np.ma.masked:
        label = label.item()
    if isinstance(label, tuple):
        label = tuple(as_label(part) for part in label)
    if _is_missing(label):
        raise ConformalError(f"not hold NaN or another missing label, found {brief(label)}")
    try:
        hash(label)
    except TypeError:
        raise ConformalError(f"hold labels that are hashable, found a {type(label).__name__}") from None
    return label  # type: ignore[no-any-return]


def factorise(labels: npt.NDArray[Any]) -> tuple[list[Hashable], IntArray]:
    """Distinct labels, and for each sample (n,) the index of its own; sorted, or as they come if they cannot be."""
    if labels.dtype.kind != "O":
        values, codes = np.unique(labels, return_inverse=True)
        return values.tolist(), codes.astype(np.int64).reshape(labels.shape)
    place: dict[Hashable, int] = {}
    codes = np.array([place.setdefault(label, len(place)) for label in labels], dtype=np.int64)
    keys: list[Any] = list(place)
    try:
        order = sorted(range(len(keys)), key=keys.__getitem__)
    except TypeError:
        return keys, codes
    rank = np.empty(len(keys), dtype=np.int64)
    rank[order] = np.arange(len(keys))
    return [keys[i] for i in order], rank[codes]


def _is_missing(label: Any) -> bool:
    """Whether a label stands for no label."""
    if label is None or label is np.ma.masked:
        return True
    try:
        return bool(label != label)  # noqa: PLR0124 - NaN and NaT differ from themselves, pandas.NA has no truth value
    except Exception:  # whatever a foreign class raises
        return True


def _as_time(label: np.datetime64 | np.timedelta64) -> Any:
    if np.isnat(label):
        return None
    kind = "M8[us]" if isinstance(label, np.datetime64) else "m8[us]"
    try:
        found, finer = label.astype(kind), label.astype(kind.replace("us", "ns"))
        plain = found.item()
        if found == label and isinstance(plain, (datetime, timedelta)):
            return plain
        return finer if finer == label else label
    except (TypeError, OverflowError):  # months have no length, far years no microseconds
        return label


def _vector(labels: Iterable[Any]) -> npt.NDArray[np.object_]:
    items = list(labels)
    arr = np.empty(len(items), dtype=object)
    for i, item in enumerate(items):
        arr[i] = item
    return arr
