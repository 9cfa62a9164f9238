"""Pictures of a table's regions and of their coverage, by matplotlib."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import ConformodalError, Diagnosis, PredictiveDensity, Regions
from conformodal.conformal.checks import as_finite, as_targets
from conformodal.core.extras import require_extra
from conformodal.core.files import naming_file, remove_leftovers, replacing

with require_extra("figures", "a picture of regions or coverage"):
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

_SET, _INSIDE, _OUTSIDE = "#56B4E9", "#0072B2", "#D55E00"
_DARKEST = 0.98  # quantile of the densities that is drawn darkest: narrow bins have peaks
_MARGIN = 0.05
_LARGE = 1e4  # values from here on have k, M or G on their axis
_VERBATIM: dict[str, Any] = {"parse_math": False}  # of text with names of columns and labels, which may hold $
_INCHES_PER_ROW, _FEWEST_ROWS, _LONGEST = 0.28, 5, 32  # of coverages; characters of a label


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
        Axes to draw on; None makes a new figure, ``ax.figure``, which is pyplot's if pyplot is in use.
    """
    n = len(regions)
    at = np.arange(n, dtype=np.float64) if x is None else as_finite(x, "x", "(n,)")
    for name, given in (("x", at), ("density", at if density is None else density)):
        if len(given) != n or n == 0:
            raise ConformodalError(f"{name} and regions must be of the same samples, got {len(given)} and {n}")
    ax = _new_figure().subplots() if ax is None else ax
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
    for rows, hatch, label in ((~endless, None, "set"), (endless, "///", "unbounded set")):
        look: Any = {"facecolors": _SET, "alpha": 0.55, "linewidths": 0, "antialiaseds": False, "hatch": hatch}
        look["label"] = label
        if rows.any():
            ax.add_collection(PolyCollection(list(corners[rows]), **look))
    if y is not None:
        values = as_targets(y, regions.bins.n_targets)
        inside, truth = regions.contains(values)[:, target], values[:, target]
        ax.plot(at[inside], truth[inside], ".", ms=3, color="black", label="inside its set")
        ax.plot(at[~inside], truth[~inside], "x", ms=5, color=_OUTSIDE, label="outside")
        shown.append(truth)
    values = np.concatenate(shown)
    reach = _MARGIN * (np.ptp(values) or 1.0)
    ax.set(xlim=(ends[0], ends[-1]), ylim=(values.min() - reach, values.max() + reach))
    ax.set_xlabel("row" if x is None else str(getattr(x, "name", None) or "feature"), **_VERBATIM)
    ax.set_ylabel(str(regions.bins.target_names[target]), **_VERBATIM)
    for axis, ends in ((ax.xaxis, at), (ax.yaxis, values)):
        if np.abs(ends).max() >= _LARGE:
            axis.set_major_formatter(EngFormatter(sep=""))
    # above the axes, where it hides no row
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=4, frameon=False, fontsize="small", markerscale=2)
    return ax


def draw_coverage(diagnosis: Diagnosis, column: int = 0, ax: Axes | None = None) -> Axes:
    """Draw one guarantee's coverage, of all samples and by group, beside its bands; of many groups the ten lowest.

    Where units calibrate there are no bands.

    Parameters
    ----------
    diagnosis
        From :func:`~conformodal.diagnose`.
    column
        Number of the guarantee: of the target, or 0 with ``joint="max"``.
    ax
        Axes to draw on; None makes a new figure, ``ax.figure``, which is pyplot's if pyplot is in use.
    """
    guarantee = diagnosis.columns[column]
    ax = _new_figure(figsize=(7, coverage_height(diagnosis, column))).subplots() if ax is None else ax
    rows, whole, banded = guarantee.rows()[::-1], guarantee.coverage, diagnosis.n_units is None
    for i, (_, check) in enumerate(rows):
        if banded:
            ax.barh(i, check.high - check.low, left=check.low, height=0.6, color=_SET, alpha=0.5)
        ax.plot(check.coverage, i, "o" if check.inside else "X", color=_INSIDE if check.inside else _OUTSIDE)
    ax.axvline(whole.rank / (whole.n_calibration + 1), color="black", lw=0.8, ls="--")
    short = [(label if len(label) <= _LONGEST else f"{label[:_LONGEST]}…", check) for label, check in rows]
    ax.set_yticks(range(len(rows)), [f"{label} ({check.n_test})" for label, check in short], **_VERBATIM)
    ax.set_xlim(left=ax.get_xlim()[0] - 0.005, right=1.005)
    ax.set_ylim(min(-1, (len(rows) - _FEWEST_ROWS) / 2), max(len(rows), (len(rows) + _FEWEST_ROWS) / 2 - 1))
    what = "coverage (bars: bands, crosses: outside)" if banded else "coverage of rows; units calibrate"
    ax.set_xlabel("\n".join(filter(None, [what, guarantee.rest()])), **_VERBATIM)
    together = f" and {diagnosis.level:.0%} band" + ("s, all at once" if diagnosis.n_bands > 1 else "")
    ax.set_title(f"{guarantee.name}: coverage{together * banded}", fontsize="medium", **_VERBATIM)
    return ax


def coverage_height(diagnosis: Diagnosis, column: int = 0) -> float:
    """Inches that the picture of a guarantee's coverage needs."""
    return 1.6 + _INCHES_PER_ROW * len(diagnosis.columns[column].rows())


def _new_figure(**options: Any) -> Figure:
    """A figure of pyplot where that is in use, for ``plt.savefig``; elsewhere one that nothing keeps in memory."""
    pyplot = sys.modules.get("matplotlib.pyplot")
    return (Figure if pyplot is None else pyplot.figure)(layout="constrained", **options)


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure as what its suffix says, marked as a picture of this package."""
    remove_leftovers(path)
    with replacing(path) as part, naming_file(path):
        figure.savefig(part, format=path.suffix[1:] or None, metadata={"Creator": "conformodal"})
