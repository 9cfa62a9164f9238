"""Pictures of a table's regions and of their coverage, on axes of matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import ConformodalError, Diagnosis, PredictiveDensity, Regions
from conformodal.conformal.checks import as_count, as_finite, as_targets
from conformodal.core.extras import require_extra

from .diagnosis import OUTSIDE, draw_column

with require_extra("figures", "pictures of regions"):
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

_SET = "#56B4E9"
_DARKEST = 0.98  # quantile of the densities that is drawn darkest: narrow bins have peaks
_MARGIN = 0.05


def draw_regions(
    regions: Regions,
    y: npt.ArrayLike | None = None,
    x: npt.ArrayLike | None = None,
    density: PredictiveDensity | None = None,
    target: int = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw the sets of one target over a feature or over rows.

    For an example see ``docs/tutorial.md``.

    Parameters
    ----------
    regions
        Of n samples. Unbounded sets are hatched: they go on beyond the outermost edges.
    y
        (n,) or (n, d) true values: dots inside their sets, crosses outside.
    x
        (n,) values of a feature; None draws over row numbers. A set reaches half way to the neighbouring values.
    density
        Of the same samples, drawn in grey behind.
    target
        Number of the target.
    ax
        Axes to draw on; None makes a new figure, ``ax.figure``.
    """
    if not isinstance(regions, Regions):
        raise ConformodalError(f"regions must be Regions, of one alpha, got {type(regions).__name__}")
    n, target = len(regions), as_count(target, "target", 0, regions.bins.n_targets - 1)
    at = np.arange(n, dtype=np.float64) if x is None else as_finite(x, "x", "(n,)")
    for name, given in (("x", at), ("density", at if density is None else density)):
        if len(given) != n or n == 0:
            raise ConformodalError(
                f"{name} and regions must be of the same samples, at least one, got {len(given)}, {n}"
            )
    ax = Figure(layout="constrained").subplots() if ax is None else ax
    order, edges = np.argsort(at, kind="stable"), regions.bins.edges_[target]
    middles = (at[order][1:] + at[order][:-1]) / 2
    half = np.ptp(at) / (2 * n) or 0.5
    ends = np.concatenate(([at.min() - half], middles, [at.max() + half]))
    offsets, intervals = regions.flat_intervals(target)
    low, high = np.clip(intervals, edges[0], edges[-1]).T
    place = np.argsort(order)[np.repeat(np.arange(n), np.diff(offsets))]
    left, right = ends[place], ends[place + 1]
    shown = [low, high]
    if density is not None:
        cells = density.bins.edges_[target]
        shade = (density.proba[target] / np.diff(cells))[order].T
        darkest = float(np.quantile(shade, _DARKEST)) or None
        ax.pcolormesh(ends, cells, shade, cmap="Greys", vmin=0, vmax=darkest, zorder=0, rasterized=True)
    corners = np.stack([np.column_stack(c) for c in ((left, low), (left, high), (right, high), (right, low))], axis=1)
    endless = np.isinf(intervals).any(axis=1)
    for rows, hatch in ((~endless, None), (endless, "///")):
        look: Any = {"facecolors": _SET, "alpha": 0.55, "linewidths": 0, "antialiaseds": False, "hatch": hatch}
        if rows.any():
            ax.add_collection(PolyCollection(list(corners[rows]), **look))
    if y is not None:
        values = as_targets(y, regions.bins.n_targets)
        inside, truth = regions.contains(values)[:, target], values[:, target]
        ax.plot(at[inside], truth[inside], ".", ms=3, color="black", label="inside its set")
        ax.plot(at[~inside], truth[~inside], "x", ms=5, color=OUTSIDE, label="outside")
        shown.append(truth)
    values = np.concatenate(shown)
    reach = _MARGIN * (np.ptp(values) or 1.0)
    ax.set(xlim=(ends[0], ends[-1]), ylim=(values.min() - reach, values.max() + reach))
    ax.set_xlabel("row" if x is None else str(getattr(x, "name", None) or "feature"))
    ax.set_ylabel(str(regions.bins.names[target] if regions.bins.names else f"target {target}"))
    return ax


def draw_coverage(diagnosis: Diagnosis, column: int = 0, ax: Axes | None = None) -> Axes:
    """Draw one guarantee's coverage, of all samples, by size and by group, beside its bands.

    For an example see ``docs/tutorial.md``; :func:`~conformodal.draw_diagnosis` draws all guarantees.

    Parameters
    ----------
    diagnosis
        From :func:`~conformodal.diagnose`.
    column
        Number of the guarantee: of the target, or 0 with ``joint="max"``.
    ax
        Axes to draw on; None makes a new figure, ``ax.figure``.
    """
    if not isinstance(diagnosis, Diagnosis):
        raise ConformodalError(f"diagnosis must be a Diagnosis, got {type(diagnosis).__name__}")
    guarantee = diagnosis.columns[as_count(column, "column", 0, len(diagnosis.columns) - 1)]
    ax = Figure(layout="constrained").subplots() if ax is None else ax
    draw_column(ax, guarantee)
    return ax
