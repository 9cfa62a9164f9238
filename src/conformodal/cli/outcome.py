"""The outcome of a run and of its evaluation in words: on the page and on the terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from conformodal.core.words import counted, noun_for
from conformodal.pipeline.model import HINDSIGHT, ONLINE
from conformodal.report.page import METHOD_LABELS

from .console import console, report_line


def describe_outcome(name: str, metrics: dict[str, Any]) -> list[str]:
    """What was answered, and what a user must know of it: the first lines of the page and on the terminal."""
    n, n_unknown, radius = counted(metrics["n_answered"], "frame"), metrics["n_unknown"], metrics["radius"]
    lines = [
        f"{name}: {n} answered, {metrics['split_note']}",
        f"Frames not reliable (motion or place): {metrics['n_unreliable']}; without an image: "
        f"{metrics['n_without_image']}; with a pose from landmarks: {metrics['n_localized']}.",
    ]
    if n_unknown:
        verb, rest = noun_for(n_unknown, "shows", "show"), metrics.get("errors_known_places", {}).get(ONLINE)
        lines.append(f"{n_unknown} of {n} {verb} no known place: the region is unbounded there.")
        if rest is not None:
            lines.append(f"Without these the online RMSE is {rest['rmse_m']:.4f} m and {rest['rmse_deg']:.4f} degrees.")
    if n_unbounded := metrics["n_unbounded"]:
        lines.append(
            f"The region is unbounded in some target in {n_unbounded} of {n}, which show a known place: too few "
            "calibration frames have the same evidence type for this alpha, or too many lie beyond the training range."
        )
    if radius is not None:
        size = "infinity: too few recordings calibrate it"
        if radius["radius_m"] is not None and radius["radius_deg"] is not None:
            size = f"{radius['radius_m']:.4f} m and {radius['radius_deg']:.2f} degrees"
        lines.append(f"The {radius['method']} pose has a radius of {size}. {radius['assumption']}")
    if metrics["stopped"]:
        lines.append(f"Stopped early: {metrics['stopped']}. All results up to then are here.")
    return lines


def report_outcome(name: str, metrics: dict[str, Any]) -> None:
    """The result on the terminal."""
    for line in describe_outcome(name, metrics):
        report_line(line)
    for frame, problem in list(metrics["problems"].items())[:3]:
        report_line(f"  {frame}: {problem}")
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
    if metrics["path_coverage"]:
        report_line(_describe_paths(metrics["path_coverage"]))


def print_errors(errors: dict[str, dict[str, float]], note: str) -> None:
    """The table of errors by method."""
    table = Table(title=f"errors, {note}", title_justify="left")
    columns = ("rmse_m", "rmse_deg", "median_m", "median_deg")
    table.add_column("method")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in errors.items():
        table.add_row(METHOD_LABELS.get(name, name), *(f"{row[column]:.4f}" for column in columns))
    console.print(table)


def describe_coverage(coverage: dict[str, Any]) -> str:
    """How often bounded regions hold the whole pose, beside the share of regions that are unbounded in some target."""
    n, n_bounded = coverage["n_evaluated"], coverage["n_bounded"]
    open_ended = f"{n - n_bounded} of {counted(n, 'region')} unbounded in some target"
    if not n_bounded:
        return f"{open_ended}, which says nothing of coverage"
    held, share = round(coverage["bounded_coverage"] * n_bounded), 100 * coverage["bounded_coverage"]
    verb = noun_for(held, "holds", "hold")
    return f"{held} of {counted(n_bounded, 'bounded region')} ({share:.1f} %) {verb} the whole pose; {open_ended}"


def _describe_paths(paths: dict[str, Any]) -> str:
    """How often regions from posteriors hold the pose, how many places they name, and confident mistakes."""
    names = {ONLINE: "From the frames so far", HINDSIGHT: "with hindsight"}
    parts = [
        f"{name}, regions hold the pose in {100 * row['coverage']:.1f} % of the frames and name "
        f"{row['mean_places'] or 0:.2f} places on average"
        for path, name in names.items()
        if (row := paths.get(path))
    ]
    missed = f"{paths['n_reliable_and_missed']} of {counted(paths['n_reliable'], 'reliable frame')}"
    return f"{'; '.join(parts)}; the region from the frames so far misses it in {missed}. {paths['assumption']}"
