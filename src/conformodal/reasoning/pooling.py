"""A softmax and pose fixes in one: probabilities over fine cells, which a region with landmarks starts from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.special import stdtr

from conformodal.conformal import QuantileBins
from conformodal.poses import PoseFix

from .fixes import odds

FloatArray = npt.NDArray[np.float64]
Kind = TypeVar("Kind", bound=np.generic)

# Fixes are finer than bins, which are cut into so many cells at least. They may also be where no training frame was, so
# cells reach beyond the bins by this share of their number on either side.
CELLS, BEYOND = 800, 0.5
_FREEDOM = 3  # of Student's t: fixes are off by many of their spreads more often than a normal law has it
_LEAST_TURNED = 1e-4


def fix_cells(bins: QuantileBins) -> QuantileBins:
    """Cells within the bins and, as wide as their mean, beyond them; edges of bins are edges of cells."""
    edges = []
    for fine, n in zip(bins.refine(_cells_a_bin(bins)).edges_, _cells_beyond(bins), strict=True):
        steps = (fine[-1] - fine[0]) / (fine.size - 1) * np.arange(1, n + 1)
        edges.append(np.concatenate((fine[0] - steps[::-1], fine, fine[-1] + steps)))
    return QuantileBins.from_edges(edges)


def on_cells(values: npt.NDArray[Kind], bins: QuantileBins, target: int) -> npt.NDArray[Kind]:
    """What is known of every bin, (n, K), said of every cell in it, (n, cells); nothing (0) beyond the bins.

    Of bins that are cut into m parts, (n, K * m), it is said of all cells cut into as many, (n, cells * m).
    """
    parts = values.shape[1] // bins.sizes[target]
    beyond = parts * _cells_beyond(bins)[target]
    return np.pad(np.repeat(values, _cells_a_bin(bins), axis=1), ((0, 0), (beyond, beyond)))


def pool_fixes(
    proba: Sequence[npt.NDArray[np.floating[Any]]],
    fixes: Sequence[Sequence[PoseFix]],
    bins: QuantileBins,
    cells: QuantileBins,
    sign_reference: FloatArray,
) -> list[FloatArray]:
    """Weighted means of softmaxes and of the fixes' densities, target by target (a linear opinion pool, Stone 1961).

    A fix counts as much as it is probably right, the softmax as much as all fixes of the frame are probably wrong. A
    mean bears a wrong softmax beside a right fix, where a product would be torn between them.

    Parameters
    ----------
    proba
        Seven arrays (n, K_j): x, y, z and the quaternion wxyz.
    fixes
        Of the same n frames; of several of one frame, one at most is right. Without any, the softmax is spread evenly
        over the cells of each bin.
    bins, cells
        Bins of the softmax, and their :func:`fix_cells`.
    sign_reference
        (4,) quaternion that fixes the signs of quaternions.

    Returns
    -------
    list of seven arrays (n, cells), rows of which sum to one
    """
    chances = [odds(of_frame) for of_frame in fixes]
    frame = np.repeat(np.arange(len(fixes)), [len(of_frame) for of_frame in fixes])
    alone = np.exp([none for none, _ in chances])
    right = np.exp(np.concatenate([np.empty(0), *(log_right for _, log_right in chances)]))
    places, spreads = _targets([fix for of_frame in fixes for fix in of_frame], sign_reference)
    pooled = []
    for j, edges in enumerate(cells.edges_):
        pool = on_cells(proba[j].astype(np.float64) / _cells_a_bin(bins), bins, j) * alone[:, None]
        away = (edges - places[:, j, None]) / spreads[:, j, None]
        np.add.at(pool, frame, right[:, None] * np.diff(stdtr(_FREEDOM, away), axis=1))
        pooled.append(pool / pool.sum(axis=1, keepdims=True))
    return pooled


def _cells_a_bin(bins: QuantileBins) -> int:
    return max(1, -(-CELLS // max(bins.sizes)))


def _cells_beyond(bins: QuantileBins) -> list[int]:
    return [round(BEYOND * _cells_a_bin(bins) * k) for k in bins.sizes]


def _targets(fixes: Sequence[PoseFix], sign_reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fixes as targets and their spreads, (m, 7) each."""
    if not fixes:
        return np.empty((0, 7)), np.empty((0, 7))
    quats = np.array([fix.orientation_quat_wxyz for fix in fixes])
    quats = np.where((quats @ sign_reference < 0)[:, None], -quats, quats)
    sigma_m, sigma_rad = (np.array([getattr(fix, name) for fix in fixes])[:, None] for name in ("sigma_m", "sigma_rad"))
    # a turn by a small angle moves a unit quaternion by half of it, at a right angle to itself
    turned = sigma_rad / 2 * np.sqrt(np.maximum(1 - quats**2, _LEAST_TURNED))
    places = np.concatenate(([fix.position_xyz for fix in fixes], quats), axis=1)
    return places, np.concatenate((np.repeat(sigma_m, 3, axis=1), turned), axis=1)
