"""What a run found, as ``metrics.json``, as a page, and on the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from conformodal.core.words import counted, noun_for
from conformodal.pipeline.model import HINDSIGHT, ONLINE

from .console import console, report_line, report_strongly

_NAMES = {
    "online": "online, as a robot gets it",
    "smoothed": "smoothed, with hindsight",
    "hindsight": "hindsight, not smoothed",
}
_SAME_CAMERA = 1e-6  # share of the image width that intrinsics may differ by: text files round them


def describe_outcome(name: str, metrics: dict[str, Any]) -> list[str]:
    """What was answered, and what a user must know of it: the first lines of the page and on the terminal."""
    n, n_unknown = counted(metrics["n_answered"], "frame"), metrics["n_unknown"]
    lines = [
        f"{name}: {n} answered, {metrics['split_note']}",
        f"Frames not reliable (motion or place): {metrics['n_unreliable']}; without an image: "
        f"{metrics['n_without_image']}; with a pose from landmarks: {metrics['n_localized']}.",
    ]
    if n_unknown:
        verb = noun_for(n_unknown, "shows", "show")
        lines.append(f"{n_unknown} of {n} {verb} no known place: the region is unbounded there.")
    rest, every = (metrics.get(table, {}).get(ONLINE) for table in ("errors_known_places", "errors"))
    if rest is not None and any(f"{rest[key]:.4f}" != f"{every[key]:.4f}" for key in ("rmse_m", "rmse_deg")):
        lines.append(f"Without these the online RMSE is {rest['rmse_m']:.4f} m and {rest['rmse_deg']:.4f} degrees.")
    if metrics["radius"] is not None:
        radius = metrics["radius"]
        size = "infinity: too few recordings calibrate it"
        if radius["radius_m"] is not None and radius["radius_deg"] is not None:
            size = f"{radius['radius_m']:.4f} m and {radius['radius_deg']:.2f} degrees"
        lines.append(f"The {radius['method']} pose has a radius of {size}. {radius['assumption']}")
    if metrics.get("stopped"):
        lines.append(f"Stopped early: {metrics['stopped']}. All results up to then are here.")
    return lines


def report_outcome(name: str, metrics: dict[str, Any], *, unbounded: bool) -> None:
    """The result on the terminal."""
    for line in describe_outcome(name, metrics):
        report_line(line)
    for frame, problem in list(metrics["problems"].items())[:3]:
        report_line(f"  {frame}: {problem}")
    if unbounded:
        report_strongly(
            "The region of a frame that shows a known place is unbounded in some target: too few calibration frames "
            "have the same evidence type for this alpha, or too many of them lie beyond the training range."
        )
    if "errors" not in metrics:
        return
    if metrics["n_with_truth"] < metrics["n_answered"]:
        report_line(f"{metrics['n_with_truth']} of {metrics['n_answered']} frames have a true pose; of these:")
    print_errors(metrics["errors"], metrics["split_note"])
    coverage, band = metrics["coverage"], metrics["coverage"]["joint_band_99"]
    between = "" if band is None else f" (99 % band {band[0]:.3f} to {band[1]:.3f})"
    report_line(
        f"{describe_coverage(coverage)}; over all frames {coverage['joint_coverage']:.3f}{between}, "
        f"alpha = {coverage['alpha']} ({coverage['joint']}). {coverage['assumption']}"
    )
    if metrics.get("path_coverage"):
        report_line(describe_paths(metrics["path_coverage"]))


def print_errors(errors: dict[str, dict[str, float]], note: str) -> None:
    """The table of errors by method."""
    table = Table(title=f"errors, {note}", title_justify="left")
    columns = ("rmse_m", "rmse_deg", "median_m", "median_deg")
    table.add_column("method")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in errors.items():
        table.add_row(_NAMES.get(name, name), *(f"{row[column]:.4f}" for column in columns))
    console.print(table)


def describe_paths(paths: dict[str, Any]) -> str:
    """How often regions from posteriors hold the pose, how many places they name, and confident mistakes."""
    names = {ONLINE: "From the frames so far", HINDSIGHT: "with hindsight"}
    parts = [
        f"{name}, regions hold the pose in {100 * row['coverage']:.1f} % of the frames and name "
        f"{row['mean_places'] or 0:.2f} places on average"
        for path, name in names.items()
        if (row := paths.get(path))
    ]
    missed = f"{paths['n_reliable_and_missed']} of {counted(paths['n_reliable'], 'reliable frame')}"
    return (
        f"{'; '.join(parts)}; the region from the frames so far misses the pose in {missed}, "
        f"{paths['n_reliable_and_elsewhere']} of them with the pose at another place. {paths['assumption']}"
    )


def describe_coverage(coverage: dict[str, Any]) -> str:
    """How often bounded regions hold the whole pose, beside the share of regions that are unbounded in some target."""
    n, n_bounded = coverage["n_evaluated"], coverage["n_bounded"]
    unbounded = f"{n - n_bounded} of {counted(n, 'region')} ({100 * coverage['abstained']:.1f} %) {{}} unbounded"
    unbounded = unbounded.format(noun_for(n - n_bounded, "is", "are"))
    if not n_bounded:
        return f"{unbounded} in some target, which says nothing of coverage"
    held, parts = round(coverage["bounded_coverage"] * n_bounded), coverage.get("by_size", [])
    smallest = f", of the {parts[0]['frames']} smallest {100 * parts[0]['coverage']:.0f} %" if len(parts) > 1 else ""
    return (
        f"{held} of {counted(n_bounded, 'bounded region')} ({100 * coverage['bounded_coverage']:.1f} %) "
        f"{noun_for(held, 'holds', 'hold')} the whole pose{smallest}; {unbounded} in some target"
    )
