"""Prediction sets over bins: per target a union of disjoint intervals, over targets a set of disjoint cuboids."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError

from .bins import QuantileBins
from .checks import as_targets, brief, column_names


class Regions:
    """Regions of n samples in d targets.

    Calibrators make them; for an example see :class:`SplitConformal`.

    Parameters
    ----------
    bins
        The bins of the targets.
    masks
        One (n, K_j) boolean array per target, or one (n, d, K) for all: the bins in the set. Not copied.
    unbounded
        (n, d): where True, the set is the whole real line, beyond the outer edges too, whatever the mask holds; or all
        that the bins' ``limits`` allow.
    """

    def __init__(self, bins: QuantileBins, masks: Sequence[BoolArray] | BoolArray, unbounded: BoolArray) -> None:
        if isinstance(masks, np.ndarray):
            masks = list(np.moveaxis(masks, 1, 0)) if masks.ndim == 3 else [masks]
        n, given = len(unbounded), [mask.shape for mask in masks]
        if given != [(n, k) for k in bins.sizes] or unbounded.shape != (n, bins.n_targets):
            sizes = f"got {brief(given)} for {bins.sizes} bins, unbounded {unbounded.shape}"
            raise ConformodalError(f"masks must hold one array (n, K) per target, of as many samples; {sizes}")
        self.bins = bins
        whole = unbounded.T[..., None]
        self.masks = [mask | rows if rows.any() else mask for mask, rows in zip(masks, whole, strict=True)]
        self.unbounded = unbounded

    def __len__(self) -> int:
        return int(self.unbounded.shape[0])

    def __repr__(self) -> str:
        return f"Regions(samples={len(self)}, targets={self.bins.n_targets}, bins={self.bins.sizes})"

    def __getitem__(self, index: slice | BoolArray | npt.NDArray[np.integer]) -> Regions:
        """Regions of some of the samples: a slice, a boolean mask or an array of positions."""
        return Regions(self.bins, [mask[index] for mask in self.masks], self.unbounded[index])

    @classmethod
    def concatenate(cls, parts: Iterable[Regions]) -> Regions:
        """Regions of all the samples of `parts`, which must have the same bins, in order."""
        parts = list(parts)
        masks = [np.concatenate([p.masks[j] for p in parts]) for j in range(parts[0].bins.n_targets)]
        return cls(parts[0].bins, masks, np.concatenate([p.unbounded for p in parts]))

    def contains(self, y: npt.ArrayLike, joint: bool = False) -> BoolArray:
        """Whether each set holds the value `y`, (n, d), or (n,) for one target; with `joint`, whether all do, (n,)."""
        column_names(y, "y", self.bins.names)
        values = as_targets(y, n_targets=self.bins.n_targets)
        if values.shape[0] != len(self):
            raise ConformodalError(f"y has {values.shape[0]} rows, the regions have {len(self)}")
        codes, at = self.bins.encode(values), np.arange(len(self))
        held = [mask[at, code] & (code >= 0) for mask, code in zip(self.masks, codes.T, strict=True)]
        low, high = self.bins.limits.T
        inside = np.stack(held, axis=1) | (self.unbounded & (low <= values) & (values <= high))
        return np.asarray(inside.all(axis=1)) if joint else inside

    def runs(self, i: int) -> list[IntArray]:
        """Runs of adjacent chosen bins of sample `i`: d arrays (m, 2) of first bin and one past the last."""
        apart = np.zeros((1, 1), dtype=bool)  # a bin between two targets that is in no set
        row = np.concatenate([part for mask in self.masks for part in (mask[[i]], apart)], axis=1)
        every, starts = _flat_runs(row)[1], np.cumsum([0, *(size + 1 for size in self.bins.sizes)])
        cuts = np.searchsorted(every[:, 0], starts)
        return [every[a:b] - start for a, b, start in zip(cuts[:-1], cuts[1:], starts[:-1], strict=True)]

    def intervals(self, i: int) -> list[FloatArray]:
        """Intervals of sample `i`: d arrays (m, 2), sorted and disjoint; the bins' limits where unbounded.

        An interval holds its lower end; it holds its upper end only if that is the target's last edge.
        """
        parts = zip(self.bins.edges_, self.runs(i), self.unbounded[i], self.bins.limits, strict=True)
        return [limits[None].copy() if unbounded else edges[runs] for edges, runs, unbounded, limits in parts]

    def flat_intervals(self, target: int = 0) -> tuple[IntArray, FloatArray]:
        """All intervals of one target: offsets (n + 1,) and ends (m, 2), the bins' limits where unbounded.

        Sample i has the rows ``offsets[i]:offsets[i + 1]`` of the ends.
        """
        offsets, runs = self.flat_runs(target)
        ends = self.bins.edges_[target][runs]
        ends[np.repeat(self.unbounded[:, target], np.diff(offsets))] = self.bins.limits[target]
        return offsets, ends

    def flat_runs(self, target: int = 0) -> tuple[IntArray, IntArray]:
        """All runs of adjacent chosen bins of one target: offsets (n + 1,), first bins and ends (m, 2)."""
        counts, runs = _flat_runs(self.masks[target])
        return np.concatenate(([0], np.cumsum(counts))), runs

    @property
    def hull(self) -> FloatArray:
        """Smallest single interval that holds each set, (n, d, 2); NaN for an empty set."""
        ends = np.empty((len(self), self.bins.n_targets, 2))
        for j, (mask, edges) in enumerate(zip(self.masks, self.bins.edges_, strict=True)):
            ends[:, j, 0] = edges[mask.argmax(axis=1)]
            ends[:, j, 1] = edges[mask.shape[1] - mask[:, ::-1].argmax(axis=1)]
            ends[~mask.any(axis=1), j] = np.nan
        return np.where(self.unbounded[..., None], self.bins.limits, ends)

    @property
    def n_intervals(self) -> IntArray:
        """Number of disjoint intervals, (n, d); 0 for an empty set."""
        starts = [np.count_nonzero(mask[:, 1:] & ~mask[:, :-1], axis=1) + mask[:, 0] for mask in self.masks]
        return np.stack(starts, axis=1).astype(np.int64)

    @property
    def length(self) -> FloatArray:
        """Total length of the intervals in the target's unit, (n, d); that of the bins' limits where unbounded."""
        lengths = np.stack([mask @ width for mask, width in zip(self.masks, self.bins.widths, strict=True)], axis=1)
        return np.where(self.unbounded, np.diff(self.bins.limits)[:, 0], lengths)

    @property
    def volume(self) -> FloatArray:
        """Product of the lengths over targets, (n,); 0 if any set is empty."""
        length = self.length
        with np.errstate(invalid="ignore", over="ignore"):
            product = length.prod(axis=1)
        return np.where((length == 0).any(axis=1), 0.0, product)


def _flat_runs(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Runs per row (n,), and all runs (m, 2) as first bin and one past the last."""
    n, k = mask.shape
    padded = np.zeros((n, k + 2), dtype=bool)
    padded[:, 1:-1] = mask
    rows, at = np.divmod(np.flatnonzero(padded[:, 1:] != padded[:, :-1]), k + 1)
    return np.bincount(rows, minlength=n) // 2, at.reshape(-1, 2)
