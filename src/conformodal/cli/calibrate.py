"""``conformodal calibrate``: a radius around the chosen pose, from recordings that the model has not seen."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from conformodal.core.words import counted, noun_for
from conformodal.io import Layout
from conformodal.localizer.radius import Guarantee, recordings_needed
from conformodal.pipeline.config import Method
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.model import METHODS
from conformodal.pipeline.results.folders import lock_output
from conformodal.pipeline.selection import calibrate_selection
from conformodal.pipeline.store import load_model, save_model

from .console import console, print_where, progress_bars, report_errors, report_line, report_strongly
from .options import OptionError
from .sources import FollowOutside, open_sequence


@report_errors
def calibrate(
    model: Annotated[Path, typer.Argument(help="Folder of a saved model; the radius is saved with it.")],
    data: Annotated[Path, typer.Argument(help="Recordings with poses that the model was not trained on.")],
    layout: Annotated[Layout, typer.Option("--format", help="Layout of the recordings.")] = Layout.AUTO,
    alpha: Annotated[float, typer.Option(help="Miscoverage rate of the radius.")] = 0.1,
    guarantee: Annotated[
        Guarantee, typer.Option(help="What holds with probability 1 - alpha: a random frame, or a whole recording.")
    ] = Guarantee.FRAME,
    method: Annotated[str, typer.Option(help="Method whose pose the radius is about.")] = METHODS[0],
    metres_per_radian: Annotated[
        float | None, typer.Option(help="Metres that count as much as one radian; the scene's depth by default.")
    ] = None,
    follow_outside: FollowOutside = False,
) -> None:
    """Give the chosen pose a radius with a coverage guarantee, calibrated on whole recordings."""
    if method not in METHODS:
        raise OptionError(f"--method must be one of {', '.join(METHODS)}, got {method!r}")
    loaded = load_model(model)
    if loaded.method is Method.PAPER:
        raise OdometryError(f"{model}: was trained with the paper's method, whose answer gets no radius")
    with lock_output(model, "train", apart=[data]):
        sequence = open_sequence(data, layout, require_poses=True, follow_outside=follow_outside)
        with progress_bars(model) as report:
            radius = calibrate_selection(loaded, sequence, alpha, guarantee, method, metres_per_radian, progress=report)
        loaded.radius = radius
        save_model(loaded, model)
    if isfinite(radius.radius_m):
        console.print(f"radius {radius.radius_m:.4f} m and {radius.radius_deg:.2f} degrees. ", end="")
        report_line(radius.assumption)
    else:
        report_strongly(
            f"The radius is infinite: {counted(radius.n_recordings, 'recording')} "
            f"{noun_for(radius.n_recordings, 'is', 'are')} too few for alpha = {alpha:g}; "
            f"at least {recordings_needed(alpha)} are needed, and more where frames could not be read."
        )
    print_where(model)
