"""A diagnosis of conformal sets as a picture: coverages beside their bands, and p-values beside the diagonal."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conformodal.conformal.diagnostics.diagnosis import ColumnDiagnosis, Diagnosis
from conformodal.core.extras import require_extra
from conformodal.core.files import replacing
from conformodal.core.words import counted

with require_extra("figures", "the picture of a diagnosis"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND, INSIDE, OUTSIDE = "#56B4E9", "#0072B2", "#D55E00"


def draw_diagnosis(diagnosis: Diagnosis, path: str | Path | None = None) -> Figure:
    """Draw a diagnosis: one row per guarantee, coverages on the left and p-values on the right.

    For an example see ``docs/tutorial.md``.

    Parameters
    ----------
    diagnosis
        From :func:`~conformodal.diagnose`.
    path
        Where to write it, if anywhere; the suffix says as what (``.svg``, ``.png``, ``.pdf``).
    """
    heights = [1.2 + 0.28 * len(column.rows()) for column in diagnosis.columns]
    figure = Figure(figsize=(10, sum(heights) + 1.2), layout="constrained")
    grid = figure.subplots(
        len(heights), 2, squeeze=False, gridspec_kw={"height_ratios": heights, "width_ratios": (3, 2)}
    )
    for (left, right), column in zip(grid, diagnosis.columns, strict=True):
        draw_column(left, column)
        _p_values(right, column)
    sizes = "; ".join(
        f"{name}: mean length {s.mean:.3g}, {s.intervals:.2f} intervals"
        for name, s in zip(diagnosis.names, diagnosis.sizes, strict=True)
    )
    figure.suptitle(
        f"Conformal sets, alpha = {diagnosis.alpha}, score {diagnosis.score}, joint {diagnosis.joint}; "
        f"{diagnosis.n_calibration} calibration, {counted(diagnosis.n_test, 'test sample')}, taken to be "
        f"exchangeable\n{sizes}",
        fontsize="medium",
        wrap=True,
    )
    if path is not None:
        with replacing(Path(path)) as part:
            figure.savefig(part, format=Path(path).suffix[1:] or None, metadata={"Creator": "conformodal"})
    return figure


def draw_column(axis: Axes, column: ColumnDiagnosis) -> None:
    """Draw the coverages of one guarantee beside their bands."""
    rows = column.rows()[::-1]
    for i, (_, check) in enumerate(rows):
        axis.barh(i, check.high - check.low, left=check.low, height=0.6, color=_BAND, alpha=0.5)
        axis.plot(check.coverage, i, "o" if check.inside else "X", color=INSIDE if check.inside else OUTSIDE)
    whole = column.coverage
    axis.axvline(whole.rank / (whole.n_calibration + 1), color="black", lw=0.8, ls="--")
    axis.set_yticks(range(len(rows)), [f"{label} ({check.n_test})" for label, check in rows])
    axis.set_xlim(right=1.005)
    axis.set_xlabel(f"coverage; bars are {whole.level:.0%} bands, crosses lie outside")
    axis.set_title(f"coverage of {column.name}", fontsize="medium")


def _p_values(axis: Axes, column: ColumnDiagnosis) -> None:
    if column.uniformity is None:
        axis.set_axis_off()
        return
    p = column.uniformity.p_values
    axis.step(p, (np.arange(p.size) + 1) / p.size, where="post", color=INSIDE)
    axis.plot([0, 1], [0, 1], color="black", lw=0.8, ls="--")
    axis.set_xlabel("p-value")
    axis.set_ylabel("share of test samples")
    axis.set_title(f"uniform? chance of as much: {column.uniformity.p_value:.3f}", fontsize="medium")
