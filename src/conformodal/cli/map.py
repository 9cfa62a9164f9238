"""``conformodal map``: from videos without poses to a recording that can be trained on."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from conformodal.core.words import length
from conformodal.mapping import KnownLength, MapReport, MapSettings, Placement, build_map
from conformodal.mapping.world import METRES, Up
from conformodal.pipeline.provenance import provenance

from .console import OUTPUT_PANEL, AsJson, Quiet, Verbose, print_json, print_where, progress_bars, report_line
from .sources import Camera, report_notes

_scale = partial(typer.Option, rich_help_panel="Scale and axes")


def map(
    videos: Annotated[list[Path], typer.Argument(metavar="VIDEO...", help="Videos, or folders of images, of a place.")],
    out: Annotated[Path, typer.Option(help="Folder to write, new or empty.", rich_help_panel=OUTPUT_PANEL)],
    known_length: Annotated[
        tuple[str, str, float] | None, _scale(metavar="A B METRES", help="Distance between the cameras of two images.")
    ] = None,
    positions: Annotated[Path | None, _scale(help="Lines 'image x y z': metres, of three images or more.")] = None,
    up: Annotated[Up, _scale(help="What of the images is up: top, or front of a camera that looks up.")] = Up.TOP,
    camera: Camera = None,
    keyframes: Annotated[int, typer.Option(min=10, help="Most keyframes, of all videos.")] = MapSettings.max_keyframes,
    trust_map: Annotated[bool, typer.Option("--trust-map", help="Write a map that is not to be trusted.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of random samples.")] = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Map videos without poses, and write a recording to train on; exit code 1 if the map is not to be trusted."""
    placement = Placement(None if known_length is None else KnownLength(*known_length), positions, up)
    settings = replace(MapSettings(), max_keyframes=keyframes, seed=seed, trust_map=trust_map)
    with progress_bars() as report:
        made = build_map(
            videos,
            out,
            placement=placement,
            camera_file=camera,
            settings=settings,
            record={"command": "map", "provenance": provenance(), "videos": [str(video) for video in videos]},
            report=report,
        )
    _report(made)
    print_json({"command": "map", **made.record(), "written": made.written})
    if made.written:
        report_line(f"next: conformodal train {out} --out MODEL")
        print_where(out)
    else:
        raise typer.Exit(1)


def _report(made: MapReport) -> None:
    """What was made, its scale, what it took, and whether it is to be trusted."""
    report_notes(made.notes)
    for line in made.quality.lines():
        report_line(line)
    if made.quality.n_clips > 1:
        for source, share in made.quality.registered_by_clip.items():
            report_line(f"  {source}: {100 * share:.0f} % of the frames")
    for camera in made.cameras:
        lens = ", ".join(f"{value:.3g}" for value in camera.distortion) or "none"
        report_line(
            f"camera: {camera.width}x{camera.height}, f = {camera.fx:.0f}, {camera.fy:.0f} px, centre {camera.cx:.0f}, "
            f"{camera.cy:.0f} px, distortion {lens}",
            detail=True,
        )
    report_line(f"path: {length(made.path_length, made.world.unit, 2)}; {_scale_of(made)}; axes: {made.world.axes}")
    report_line(f"took {made.seconds:.0f} s and at most {made.peak_bytes / 1e9:.1f} GB of memory")
    if made.reasons:
        report_line("map: not to be trusted", bold=True)
        for number, reason in enumerate(made.reasons, start=1):
            report_line(f"  {number}. {reason}", bold=True)
        if not made.written:
            report_line("nothing was written; --trust-map writes it all the same")
    else:
        report_line("map: good enough to train on", bold=True)


def _scale_of(made: MapReport) -> str:
    """Where the scale comes from."""
    if made.world.unit != METRES:
        return "lengths are in map units; --known-length or --positions makes them metres"
    residuals = made.world.residuals_m
    if not residuals.size:
        return "scale by the known length"
    return f"positions fit within {np.median(residuals):.3f} m (median), {residuals.max():.3f} m (largest)"
