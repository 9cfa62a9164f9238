"""What a run found, as ``metrics.json``, as a page, and on the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.words import counted, noun_for
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.evaluate import coverage_table, error_table, is_exchangeable, radius_table
from conformodal.pipeline.identity import identify
from conformodal.pipeline.model import HINDSIGHT, ONLINE, PoseModel
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.results.statistics import RegionStatistics

from .console import console, print_errors, report_line, report_strongly

_SAME_CAMERA = 1e-6  # share of the image width that intrinsics may differ by: text files round them


class Part(StrEnum):
    """Which frames of a source to answer."""

    ALL = "all"
    TRAIN = "train"
    CALIBRATION = "calibration"
    TEST = "test"


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """True poses of answered frames, and what is known of these frames' regions."""

    truth: Trajectory
    regions: RegionStatistics
    frames: IntArray | None = None  # which of the answered frames they are, counted from 0; None for all
    paths: dict[str, Any] | None = None  # coverage of their regions from posteriors; None without such regions


def part_frames(model: PoseModel, sequence: Recording, part: Part) -> IntArray | None:
    """Where the frames of a part of the model's own data set are in a sequence, increasing; None for all.

    They are known by their pixels. Those that the sequence has not are left out, and their number is printed.
    """
    if part is Part.ALL:
        return None
    rows = model.split.part(str(part))
    here = identify(sequence, model.known_frames)
    found = model.known_frames.find(here)
    at, moved = found.at[rows], found.moved[rows]
    its, n = f"the {part} part of the model's data set ({model.configuration['data']})", len(rows)
    seen = np.maximum(at, moved)
    if (seen < 0).all():
        raise OdometryError(
            f"{sequence.name}: none of its {counted(len(sequence), 'frame')} has the pixels of one of the "
            f"{counted(n, 'frame')} of {its}; give that data set, or run on all of this one"
        )
    try:
        model.check_camera(sequence.camera, _SAME_CAMERA)
    except OdometryError as exc:
        path = sequence.image_paths[seen[seen >= 0].min()]
        raise OdometryError(f"{path}: has the pixels of a frame of {its}, but another camera: {exc}") from None
    if (moved >= 0).any():
        first = moved[moved >= 0].min()
        expected = model.known_frames.poses[rows[moved == first][0]]
        raise OdometryError(
            f"{sequence.image_paths[first]}: has the pixels of a frame of {its}, but another pose, and so have "
            f"{(moved >= 0).sum()} of {counted(n, 'frame')}; found x y z qw qx qy qz "
            f"{here.poses[first].round(6).tolist()}, expected {expected.round(6).tolist()}"
        )
    if (at < 0).any():
        n_missing = int((at < 0).sum())
        are, have = noun_for(n_missing, "is", "are"), noun_for(n_missing, "has", "have")
        which = f"{n_missing} of {counted(n, 'frame')} of the {part} part"
        report_line(f"{which} {are} not in {sequence.name}, or {have} no pose there")
    return np.sort(at[at >= 0])


def run_metrics(
    model: PoseModel,
    part: Part,
    trajectories: dict[str, Trajectory],
    known: GroundTruth | None,
    counts: dict[str, Any],
    *,
    whole: bool = True,
) -> dict[str, Any]:
    """The content of ``metrics.json``.

    `whole` is whether every frame of the part was answered, as in calibration: the guarantee holds for these only.
    """
    metrics = _origin(model, part) | {
        "split": str(model.split.kind),
        "split_note": _split_note(model, part, counts["n_answered"]),
        **counts,
    }
    # whole recordings calibrated it: some of a recording's frames alone are answered otherwise, and it says nothing
    radius = model.radius if whole and part is Part.ALL else None
    truth, frames = (None, None) if known is None else (known.truth, known.frames)
    metrics["radius"] = radius_table(radius, trajectories, truth, frames)
    if known is not None:
        metrics["n_with_truth"] = len(known.truth)
        if frames is not None:
            trajectories = {name: trajectory[frames] for name, trajectory in trajectories.items()}
        metrics["errors"] = error_table(trajectories, known.truth)
        shown = known.regions.kinds != EvidenceType.UNKNOWN
        if shown.any() and not shown.all():
            there = {name: trajectory[shown] for name, trajectory in trajectories.items()}
            metrics["errors_known_places"] = error_table(there, known.truth[shown])
        whole = whole and part is not Part.ALL and counts["n_answered"] == len(model.split.part(str(part)))
        exchangeable, seen = whole and is_exchangeable(model, str(part)), part in (Part.TRAIN, Part.CALIBRATION)
        metrics["coverage"] = coverage_table(known.regions, model, exchangeable=exchangeable, seen=seen)
        metrics["path_coverage"] = known.paths
    return metrics


def unfinished_metrics(model: PoseModel, part: Part, digest: str | None) -> dict[str, Any]:
    """What a run that is killed leaves as its metrics: enough to evaluate what it has written."""
    return _origin(model, part) | {"unfinished": True, "model": digest}


def _origin(model: PoseModel, part: Part) -> dict[str, Any]:
    return {
        "command": "run",
        "provenance": provenance(),
        "configuration": {**model.settings, "part": str(part)},
        "seed": model.split.seed,
        "sign_reference_quat_wxyz": model.sign_reference.tolist(),
    }


def summary(name: str, metrics: dict[str, Any]) -> list[str]:
    """The page's first lines."""
    lines = [
        f"{name}: {counted(metrics['n_answered'], 'frame')} answered, {metrics['split_note']}",
        f"Frames not reliable (motion or place): {metrics['n_unreliable']}; without an image: "
        f"{metrics['n_without_image']}; with a pose from landmarks: {metrics['n_localized']}.",
    ]
    lines += [f"{line}." for line in _describe_unknown(metrics)]
    if metrics["radius"] is not None:
        radius = metrics["radius"]
        lines.append(f"The {radius['method']} pose has a radius of {_size(radius)}. {radius['assumption']}")
    if metrics.get("stopped"):
        lines.append(f"Stopped early: {metrics['stopped']}. All results up to then are here.")
    return lines


def report_outcome(metrics: dict[str, Any], *, unbounded: bool) -> None:
    """The result on the terminal."""
    lost = f", {metrics['n_without_image']} without an image" if metrics["n_without_image"] else ""
    localized = f", landmarks gave a pose in {metrics['n_localized']}" if metrics["n_localized"] else ""
    console.print(f"{counted(metrics['n_answered'], 'frame')}, {metrics['n_unreliable']} not reliable{localized}{lost}")
    for name, why in list(metrics["problems"].items())[:3]:
        report_line(f"  {name}: {why}")
    for line in _describe_unknown(metrics):
        report_line(line)
    if unbounded:
        report_strongly(
            "The region of a frame that shows a known place is unbounded in some target: too few calibration frames "
            "have the same evidence type for this alpha, or too many of them lie beyond the training range."
        )
    if metrics["radius"] is not None:
        console.print(f"radius of the {metrics['radius']['method']} pose: {_size(metrics['radius'])}")
    if "errors" in metrics:
        if metrics["n_with_truth"] < metrics["n_answered"]:
            console.print(f"{metrics['n_with_truth']} of {metrics['n_answered']} frames have a true pose; of these:")
        print_errors(metrics["errors"], metrics["split_note"])
        coverage, band = metrics["coverage"], metrics["coverage"]["joint_band_99"]
        between = "" if band is None else f" (99 % band {band[0]:.3f} to {band[1]:.3f})"
        report_line(
            f"{describe_coverage(coverage)}; over all frames {coverage['joint_coverage']:.3f}{between}, "
            f"alpha = {coverage['alpha']} ({coverage['joint']}). {coverage['assumption']}"
        )
        if metrics.get("path_coverage"):
            report_line(describe_paths(metrics["path_coverage"]))


def describe_paths(paths: dict[str, Any]) -> str:
    """How often regions from posteriors hold the pose, how many places they name, and confident mistakes."""
    named = {ONLINE: "from the frames so far", HINDSIGHT: "with hindsight"}
    parts = [
        f"{what}, regions hold the pose in {100 * its['coverage']:.1f} % of the frames and name "
        f"{its['mean_places'] or 0:.2f} places on average"
        for path, what in named.items()
        if (its := paths.get(path))
    ]
    missed = f"{paths['n_reliable_and_missed']} of {counted(paths['n_reliable'], 'reliable frame')}"
    text = (
        f"{'; '.join(parts)}; the region from the frames so far misses the pose in {missed}, "
        f"{paths['n_reliable_and_elsewhere']} of them with the pose at another place. {paths['assumption']}"
    )
    return text[0].upper() + text[1:]


def _describe_unknown(metrics: dict[str, Any]) -> list[str]:
    """Frames that show no known place, and the errors without them; empty if there are none."""
    n, n_answered = metrics["n_unknown"], metrics["n_answered"]
    if not n:
        return []
    shows, their, it = ("shows", "its", "it") if n == 1 else ("show", "their", "them")
    lines = [f"{n} of {counted(n_answered, 'frame')} {shows} no known place: {their} region is unbounded"]
    rest, whole = (metrics.get(name, {}).get(ONLINE) for name in ("errors_known_places", "errors"))
    if rest is not None and any(f"{rest[name]:.4f}" != f"{whole[name]:.4f}" for name in ("rmse_m", "rmse_deg")):
        lines.append(f"Without {it} the online RMSE is {rest['rmse_m']:.4f} m and {rest['rmse_deg']:.4f} degrees")
    return lines


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


def _size(radius: dict[str, Any]) -> str:
    if radius["radius_m"] is None or radius["radius_deg"] is None:
        return "infinity: too few recordings calibrate it"
    return f"{radius['radius_m']:.4f} m and {radius['radius_deg']:.2f} degrees"


def _split_note(model: PoseModel, part: Part, n_answered: int) -> str:
    if part is Part.ALL:
        return "all frames of the source (training frames among them, if the source is the training data)."
    n = len(model.split.part(str(part)))
    some = "" if n_answered == n else f"{n_answered} of {counted(n, 'frame')} of "
    return f"{some}the {part} part of split {model.split.kind}, seed {model.split.seed}."
