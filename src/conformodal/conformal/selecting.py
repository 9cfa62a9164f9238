"""The k-th smallest of very many numbers, without a sorted copy of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

_ROWS, _DIGIT = 1 << 20, 16


def kth_smallest(values: npt.NDArray[np.floating[Any]], k: int) -> npt.NDArray[np.floating[Any]]:
    """The k-th smallest, from 1, of a vector without NaN, as an array without axes; it may be a mapped file.

    The bits of floating numbers, read as whole numbers, have the order of the numbers themselves once those of negative
    ones are turned over. So the number is found digit by digit, sixteen bits at a time from the highest: each pass
    counts, block by block, the digits of the numbers that begin with the digits found so far. The work on the way takes
    a few megabytes, whatever the size of the vector.
    """
    unsigned = np.dtype(f"u{values.dtype.itemsize}")
    found, left = 0, k  # the digits so far, and the rank among the numbers that begin with them
    for shift in range(8 * unsigned.itemsize - _DIGIT, -1, -_DIGIT):
        counts = np.zeros(1 << _DIGIT, dtype=np.int64)
        for start in range(0, values.size, _ROWS):
            places = _in_order(values[start : start + _ROWS], unsigned) >> unsigned.type(shift)
            if shift + _DIGIT < 8 * unsigned.itemsize:
                places = places[places >> unsigned.type(_DIGIT) == found]
            counts += np.bincount((places & unsigned.type((1 << _DIGIT) - 1)).astype(np.int64), minlength=1 << _DIGIT)
        reached = np.cumsum(counts)
        digit = int(np.searchsorted(reached, left))
        left -= int(reached[digit] - counts[digit])
        found = (found << _DIGIT) | digit
    top = 1 << (8 * unsigned.itemsize - 1)
    bits = found ^ top if found & top else found ^ (2 * top - 1)
    return np.array([bits], dtype=unsigned).view(values.dtype).reshape(())


def _in_order(block: npt.NDArray[np.floating[Any]], unsigned: np.dtype[Any]) -> npt.NDArray[Any]:
    """Whole numbers in the order of the floating ones; both zeros are the same."""
    bits = (block + block.dtype.type(0)).view(unsigned)  # minus zero plus zero is zero
    top = unsigned.type(1 << (8 * unsigned.itemsize - 1))
    return np.where(bits & top, ~bits, bits | top)
