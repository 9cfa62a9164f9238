"""A diagnosis of conformal sets as a picture: coverages beside their bands."""

from __future__ import annotations

from pathlib import Path

from conformodal.conformal.diagnostics.diagnosis import ColumnDiagnosis, Diagnosis
from conformodal.core.extras import require_extra
from conformodal.core.files import replacing
from conformodal.core.words import counted

with require_extra("figures", "the picture of a diagnosis"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND, INSIDE, OUTSIDE = "#56B4E9", "#0072B2", "#D55E00"


def draw_diagnosis(diagnosis: Diagnosis, path: str | Path | None = None) -> Figure:
    """Draw a diagnosis: the coverages of each guarantee beside their bands.

    For an example see ``docs/tutorial.md``.

    Parameters
    ----------
    diagnosis
        From :func:`~conformodal.diagnose`.
    path
        Where to write it, if anywhere; the suffix says as what (``.svg``, ``.png``, ``.pdf``).
    """
    heights = [1.2 + 0.28 * len(column.rows()) for column in diagnosis.columns]
    figure = Figure(figsize=(8, sum(heights) + 1.2), layout="constrained")
    axes = figure.subplots(len(heights), squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for axis, column in zip(axes, diagnosis.columns, strict=True):
        draw_column(axis, column)
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
