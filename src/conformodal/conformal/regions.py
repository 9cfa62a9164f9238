"""Prediction sets over bins: per target a union of disjoint intervals, over targets a set of disjoint cuboids."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .bins import QuantileBins
from .checks import as_targets
from .errors import ConformalError

BoolArray = npt.NDArray[np.bool_]


class Regions:
    """Regions of n samples in d targets.

    Parameters
    ----------
    bins
        The bins of the targets.
    masks
        One (n, K_j) boolean array a target: which bins belong to the set.
    unbounded
        (n, d): where True, the set is the whole real line, beyond the outer edges too, whatever the mask says.
        This is the honest answer when the calibration data is too short for alpha.

    Raises
    ------
    ConformalError
        If shapes do not fit the bins.
    """

    def __init__(self, bins: QuantileBins, masks: Sequence[BoolArray], unbounded: BoolArray) -> None:
        if len(masks) != bins.n_targets:
            raise ConformalError(f"masks must hold one array a target ({bins.n_targets}), got {len(masks)}")
        n = masks[0].shape[0]
        for j, (mask, k) in enumerate(zip(masks, bins.sizes, strict=True)):
            if mask.shape != (n, k) or mask.dtype != np.bool_:
                raise ConformalError(f"mask of target {j} must be boolean ({n}, {k}), got {mask.dtype} {mask.shape}")
        if unbounded.shape != (n, bins.n_targets):
            raise ConformalError(f"unbounded must have shape ({n}, {bins.n_targets}), got {unbounded.shape}")
        self.bins = bins
        self.masks = [mask | unbounded[:, j, None] for j, mask in enumerate(masks)]
        self.unbounded = unbounded

    def __len__(self) -> int:
        return int(self.unbounded.shape[0])

    def __getitem__(self, index: slice | npt.NDArray[np.bool_] | npt.NDArray[np.integer]) -> Regions:
        """Regions of some of the samples: a slice, a boolean mask or an array of positions."""
        return Regions(self.bins, [m[index] for m in self.masks], self.unbounded[index])

    def contains(self, y: npt.ArrayLike, joint: bool = False) -> BoolArray:
        """Whether each set holds the value: (n, d), or (n,) when all targets must hold at once.

        Parameters
        ----------
        y
            (n, d) values, or (n,) for one target.
        joint
            True asks for all targets together.
        """
        codes = self.bins.encode(as_targets(y, n_targets=self.bins.n_targets))
        if codes.shape[0] != len(self):
            raise ConformalError(f"y has {codes.shape[0]} rows, the regions have {len(self)}")
        inside = self.unbounded.copy()
        rows = np.arange(len(self))
        for j, mask in enumerate(self.masks):
            known = codes[:, j] >= 0
            inside[known, j] = mask[rows[known], codes[known, j]]
        return np.asarray(inside.all(axis=1)) if joint else inside

    def runs(self, i: int) -> list[npt.NDArray[np.int64]]:
        """Runs of adjacent chosen bins of sample `i`: d arrays (m, 2) of first bin and one past the last."""
        return [_runs(mask[i]) for mask in self.masks]

    def intervals(self, i: int) -> list[npt.NDArray[np.float64]]:
        """Intervals of sample `i`: d arrays (m, 2), sorted and disjoint; ``[-inf, inf]`` where unbounded."""
        found = []
        for j, (edges, runs) in enumerate(zip(self.bins.edges_, self.runs(i), strict=True)):
            whole = np.array([[-np.inf, np.inf]])
            found.append(whole if self.unbounded[i, j] else edges[runs])
        return found

    @property
    def n_intervals(self) -> npt.NDArray[np.int64]:
        """Number of disjoint intervals, (n, d); 0 for an empty set."""
        counts = [m[:, 0].astype(np.int64) + (m[:, 1:] & ~m[:, :-1]).sum(axis=1) for m in self.masks]
        return np.stack(counts, axis=1)

    @property
    def length(self) -> npt.NDArray[np.float64]:
        """Total length of the intervals in the target's unit, (n, d); ``inf`` where unbounded."""
        lengths = np.stack([m @ w for m, w in zip(self.masks, self.bins.widths, strict=True)], axis=1)
        return np.where(self.unbounded, np.inf, lengths)

    @property
    def volume(self) -> npt.NDArray[np.float64]:
        """Product of the lengths over targets, (n,); 0 if any set is empty."""
        length = self.length
        with np.errstate(invalid="ignore"):
            product = length.prod(axis=1)
        return np.where((length == 0).any(axis=1), 0.0, product)


def _runs(mask: BoolArray) -> npt.NDArray[np.int64]:
    padded = np.concatenate(([False], mask, [False]))
    return np.flatnonzero(padded[1:] != padded[:-1]).reshape(-1, 2)
