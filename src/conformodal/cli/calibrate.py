"""``conformodal calibrate``: a radius around the chosen pose, from recordings that the model has not seen."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from conformodal.conformal.checks import as_alpha
from conformodal.core.words import counted, noun_for
from conformodal.io import Layout
from conformodal.localizer.radius import Guarantee, recordings_needed
from conformodal.pipeline.config import Method, OdometryError
from conformodal.pipeline.model import METHODS
from conformodal.pipeline.results import lock_output
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import calibrate_selection

from .console import OptionError, print_where, progress_bars, report_line
from .sources import DataLayout, SavedModel, open_sequence


def calibrate(
    model: SavedModel,
    data: Annotated[Path, typer.Argument(help="Recordings with poses that the model was not trained on.")],
    layout: DataLayout = Layout.AUTO,
    alpha: Annotated[float, typer.Option(help="Miscoverage rate of the radius.")] = 0.1,
    guarantee: Annotated[
        Guarantee, typer.Option(help="What holds with probability 1 - alpha: a random frame, or a whole recording.")
    ] = Guarantee.FRAME,
    method: Annotated[str, typer.Option(help=f"Method whose pose the radius is about: {', '.join(METHODS)}.")] = (
        METHODS[0]
    ),
    metres_per_radian: Annotated[
        float | None,
        typer.Option(min=0.001, help="Metres that count as much as one radian; the scene's depth by default."),
    ] = None,
) -> None:
    """Give the chosen pose a radius with a coverage guarantee, calibrated on whole recordings."""
    if method not in METHODS:
        raise OptionError(f"--method must be one of {', '.join(METHODS)}, got {method!r}")
    as_alpha(alpha)
    loaded = load_model(model)
    if loaded.method is Method.PAPER:
        raise OdometryError(f"{model}: was trained with the paper's method, whose answer gets no radius")
    with lock_output(model, "train", apart=[data]):
        sequence = open_sequence(data, layout, require_poses=True)
        with progress_bars(model) as report:
            loaded.radius = radius = calibrate_selection(
                loaded, sequence, alpha, guarantee, method, metres_per_radian, progress=report
            )
        save_model(loaded, model)
    if isfinite(radius.radius_m):
        report_line(f"radius {radius.radius_m:.4f} m and {radius.radius_deg:.2f} degrees. {radius.assumption}")
    else:
        report_line(
            f"The radius is infinite: {counted(radius.n_recordings, 'recording')} "
            f"{noun_for(radius.n_recordings, 'is', 'are')} too few for alpha = {alpha:g}; "
            f"at least {recordings_needed(alpha)} are needed, and more where frames could not be read.",
            bold=True,
        )
    print_where(model)
