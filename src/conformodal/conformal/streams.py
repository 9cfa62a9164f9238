"""Order statistics of scores that do not fit into memory: exact, from a source that is read several times."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias, TypeGuard

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import FloatArray, IntArray, RealArray
from conformodal.core.errors import ConformodalError

from .checks import as_scores, brief

# a function that returns the chunks of scores, (m,) or (m, d), from the first on, each time it is called; or a file
ScoreSource: TypeAlias = "Callable[[], Iterable[npt.ArrayLike]] | np.memmap[Any, Any]"

_CHUNK = 2**18  # rows of a file at once
_LEVELS = 4  # digits of a float64, of 16 bits each
_DIGITS = 2**16
_TABLES = 64  # counts kept, of half a megabyte each


def is_source(scores: Any) -> TypeGuard[ScoreSource]:
    """Whether scores are read from a source, or would have to be: of an iterator the stream says so."""
    return callable(scores) or isinstance(scores, np.memmap) or hasattr(scores, "__next__")


class ScoreStream:
    """Scores of a source, of which only counts are kept.

    Floats in the order of their bits are sorted by digits of 16 bits: the first pass counts the leading digits of all
    scores, three further ones the next digits of those that begin as the score asked for. The result is the very score
    that sorting would give. Kept are one chunk, and up to 64 tables of half a megabyte.

    Parameters
    ----------
    source
        A function without arguments that returns the chunks, each (m,) or (m, d); or a :class:`numpy.memmap`. An
        iterator is refused: it cannot be read again.
    change
        What is applied to each chunk (m, d), or None.

    Attributes
    ----------
    shape : (n, d) of all scores, changed ones
    dtype : of the scores as given

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal.streams import ScoreStream
    >>> stream = ScoreStream(lambda: (np.arange(start, start + 10.0) for start in (20, 0, 10)))
    >>> stream.smallest(7), len(stream)
    (6.0, 30)
    """

    def __init__(self, source: ScoreSource, change: Callable[[RealArray], RealArray] | None = None) -> None:
        if hasattr(source, "__next__") or not (callable(source) or isinstance(source, np.memmap)):
            raise ConformodalError(
                "source must be a function that returns the chunks anew, or a numpy.memmap, as it is read several "
                f"times, got {brief(source)}"
            )
        self._source, self._change = source, change
        n, kinds, counts = 0, [], list[IntArray]()
        for given in self._given():
            kinds.append(given.dtype)
            chunk = given if change is None else change(given)
            n += len(chunk)
            counts = counts or [np.zeros(_DIGITS, dtype=np.int64) for _ in range(chunk.shape[1])]
            if chunk.shape[1] != len(counts):
                raise ConformodalError(f"source has {len(counts)} columns, then {chunk.shape[1]} from row {n} on")
            for j, column in enumerate(chunk.T):
                counts[j] += _digits(_keys(column), 0)
            kinds = [np.result_type(*kinds)]
        if not n:
            raise ConformodalError("source must hold at least one score")
        self.shape, self.dtype = (n, len(counts)), kinds[0]
        self._counts = counts
        self._deeper: OrderedDict[tuple[int, int, int], IntArray] = OrderedDict()

    def __len__(self) -> int:
        return self.shape[0]

    def smallest(self, k: int, column: int = 0, others: npt.ArrayLike = ()) -> float:
        """The k-th smallest score of a column and of `others` (m,), with k from 1."""
        more, prefix = _keys(np.asarray(others, dtype=np.float64)), 0
        if not 1 <= k <= len(self) + more.size:
            raise ConformodalError(f"k must be in 1 to {len(self) + more.size}, got {k}")
        n_sharing = len(self)
        for level in range(_LEVELS):
            counts = self._counts[column] if level == 0 else self._counts_below(column, level, prefix)
            if counts.sum() != n_sharing:
                raise ConformodalError("source must hold the same scores whenever it is read: they have changed")
            reached = np.cumsum(counts + _digits(_sharing(more, level, prefix), level))
            digit = int(np.searchsorted(reached, k))
            k -= int(reached[digit - 1]) if digit else 0
            prefix, n_sharing = (prefix << 16) | digit, counts[digit]
        return _value(prefix)

    def _counts_below(self, column: int, level: int, prefix: int) -> IntArray:
        """Counts of the digits of a level, of the scores that begin with a prefix."""
        key = (column, level, prefix)
        if key not in self._deeper:
            counts = np.zeros(_DIGITS, dtype=np.int64)
            for chunk in self.chunks():
                counts += _digits(_sharing(_keys(chunk[:, column]), level, prefix), level)
            self._deeper[key] = counts
            if len(self._deeper) > _TABLES:
                self._deeper.popitem(last=False)
        self._deeper.move_to_end(key)
        return self._deeper[key]

    def chunks(self) -> Iterator[RealArray]:
        """The scores, chunk by chunk, each (m, d)."""
        return self._given() if self._change is None else map(self._change, self._given())

    def _given(self) -> Iterator[RealArray]:
        source = self._source
        given = source() if callable(source) else (source[i : i + _CHUNK] for i in range(0, len(source), _CHUNK))
        for part in given:
            chunk = as_scores(part)
            if chunk.ndim not in (1, 2):
                raise ConformodalError(f"chunks of scores must have shape (m,) or (m, d), got {chunk.shape}")
            chunk = chunk[:, None] if chunk.ndim == 1 else chunk
            if len(chunk):
                yield chunk


def _keys(values: RealArray) -> npt.NDArray[np.uint64]:
    """Whole numbers in the order of floats; both zeros are equal."""
    bits = (np.asarray(values, dtype=np.float64) + 0.0).view(np.int64)
    bits ^= (bits >> 63) & np.int64(2**63 - 1)
    return bits.view(np.uint64) ^ np.uint64(1 << 63)


def _value(key: int) -> float:
    bits = key ^ (1 << 63) if key >> 63 else key ^ (2**64 - 1)
    return float(np.array([bits], dtype=np.uint64).view(np.float64)[0])


def _sharing(keys: npt.NDArray[np.uint64], level: int, prefix: int) -> npt.NDArray[np.uint64]:
    """The keys that begin with a prefix, that of the levels before."""
    return keys if level == 0 else keys[keys >> np.uint64(64 - 16 * level) == np.uint64(prefix)]


def _digits(keys: npt.NDArray[np.uint64], level: int) -> IntArray:
    """How often each digit of a level occurs."""
    digits = (keys >> np.uint64(48 - 16 * level)) & np.uint64(_DIGITS - 1)
    return np.bincount(digits.view(np.int64), minlength=_DIGITS)


def stream_quantiles(stream: ScoreStream, rank: int) -> FloatArray:
    """The scores (d,) of a rank, of every column; ``inf`` beyond the number of scores."""
    if rank > len(stream):
        return np.full(stream.shape[1], np.inf)
    return np.array([stream.smallest(rank, j) for j in range(stream.shape[1])])
