"""Findings about a recording: the numbers, a verdict, and at most three pieces of advice."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from conformodal.core.words import counted, finite_or_none, length
from conformodal.io import SplitError, SplitKind, make_split
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.guarantee import WHERE, EvidenceGuarantee

from .examining import RecordingQuality
from .view_coverage import QUALITY, Stretch


def verdict(quality: RecordingQuality) -> str:
    """Whether the recording is good enough: yes, yes with an exception, or no."""
    unbounded, coverage, places = _unbounded(quality), quality.coverage, quality.ambiguity
    if places is None and not quality.guarantees:  # without a model
        try:
            make_split(quality.sequence.recording[quality.posed], SplitKind.BLOCKS)
        except SplitError as exc:
            return f"good enough: no, {exc}"
    if unbounded:
        return f"good enough: no, {unbounded[0].describe()}"
    weak = []
    if coverage is not None and coverage.sparse_frames.sum() > QUALITY.most_share * quality.n_held_out:
        weak.append("sparsely covered")
    if places is not None and (places.n_places > 1).sum() > QUALITY.most_share * len(places.frames):
        weak.append("ambiguous")
    if coverage is not None and coverage.fast:
        weak.append("fast")
    return f"good enough: yes, but {' and '.join(weak)} in places" if weak else "good enough: yes"


def describe_size(quality: RecordingQuality) -> str:
    """How large the regions of frames are that the model has not seen."""
    if (places := quality.ambiguity) is None:
        return "unknown: the model has seen all frames"
    size = " x ".join(f"{side:.3g}" for side in places.median_length)
    some = f"regions are {size} {quality.sequence.unit} (x, y, z; median), " if places.n_bounded else ""
    n = counted(len(places.frames), "frame")
    return f"{some}bounded in {places.n_bounded} of {n} that the model has not seen"


def numbers(quality: RecordingQuality) -> list[str]:
    """The findings, one per line."""
    lines, coverage, places = [], quality.coverage, quality.ambiguity
    if coverage is not None and quality.n_held_out:  # frames that the model was trained on cover themselves
        lines.append(
            f"sparsely covered: {coverage.sparse_frames.sum()} of {counted(quality.n_held_out, 'frame')} that the "
            f"model was not trained on (more than {_limit(QUALITY.sparse, quality)} from the nearest known view)"
        )
    if coverage is not None:
        stretches = counted(len(coverage.fast), "stretch", "stretches")
        lines.append(f"fast motion: {stretches} (more than {_limit(QUALITY.fast, quality)} from frame to frame)")
    if places is not None:
        lines.append(
            f"ambiguous: {(places.n_places > 1).sum()} of {counted(len(places.frames), 'frame')} that the model has "
            f"not seen; unknown place: {places.n_unknown}"
        )
    return lines + [guarantee.describe() for guarantee in quality.guarantees]


def advice(quality: RecordingQuality) -> list[str]:
    """What to record or train on next, the most valuable first; empty where nothing is missing."""
    lines = []
    for guarantee in _unbounded(quality):  # too few calibration frames, or too many of them beyond the training range
        enough = guarantee.weight >= guarantee.weight_needed
        what = "training data that reach further" if enough else "more, or ask for a larger alpha"
        lines.append(f"Record {what}: regions are unbounded {WHERE[guarantee.evidence]}.")
    coverage, places = quality.coverage, quality.ambiguity
    sparse, fast = ([], []) if coverage is None else (coverage.sparse, coverage.fast)
    ambiguous = [] if places is None else places.stretches
    for text, stretches in (
        ("Record, or train on, {}: the nearest known view is {} away.", sparse),
        ("Move more slowly, or record more views, in {}: up to {} from frame to frame.", fast),
        ("Record the way from one to the other in one piece: {} look like places {}.", ambiguous),
    ):
        # most errors are to be expected in long stretches far from everything known
        for one in sorted(stretches, key=lambda one: -one.change * (one.last - one.first + 1)):
            change = f"{length(one.distance_m, quality.sequence.unit, 2)} and {one.angle_deg:.0f} degrees"
            if one.alike_xyz is not None:
                change = _around(one.alike_xyz, quality)
            lines.append(text.format(_where(one, quality), change))
    return lines[: QUALITY.most_advice]


def quality_record(quality: RecordingQuality) -> dict[str, Any]:
    """The findings for ``metrics.json``."""
    record: dict[str, Any] = {
        "verdict": verdict(quality),
        "summary": numbers(quality),
        "advice": advice(quality),
        "settings": asdict(QUALITY),
        "n_frames": len(quality.sequence),
        "n_with_pose": len(quality.posed),
        "n_known": len(quality.posed) - quality.n_held_out,
        "guarantees": [{**asdict(one), "evidence": one.evidence.name.lower()} for one in quality.guarantees],
    }
    coverage, places = quality.coverage, quality.ambiguity
    if coverage is not None:
        record["scale"] = asdict(quality.scale)
        record |= {name: [_row(one) for one in getattr(coverage, name)] for name in ("sparse", "fast")}
        record["n_sparse_frames"] = int(coverage.sparse_frames.sum())
    if places is not None:
        record["ambiguity"] = {
            "n_looked_at": len(places.frames),
            "n_ambiguous": int((places.n_places > 1).sum()),
            "n_unknown": places.n_unknown,
            "stretches": [_row(one) for one in places.stretches],
        }
    return record


def _unbounded(quality: RecordingQuality) -> list[EvidenceGuarantee]:
    """Guarantees without bounded regions; disturbed images are made, not recorded."""
    recorded = [one for one in quality.guarantees if one.evidence is not EvidenceType.DISTURBED]
    return [one for one in recorded if not one.finite and one.n_frames]


def _limit(share: float, quality: RecordingQuality) -> str:
    """A share of the view, as an angle and a distance."""
    turn = share * quality.scale.fov_rad
    return f"{np.degrees(turn):.1f} degrees or {length(turn * quality.scale.depth_m, quality.sequence.unit, 2)}"


def _where(one: Stretch, quality: RecordingQuality) -> str:
    """A stretch by its frames, their files if there are several recordings, and its place."""
    text = f"frame {one.first}" if one.first == one.last else f"frames {one.first} to {one.last}"
    if len(np.unique(quality.sequence.recording)) > 1:
        paths = [quality.sequence.image_paths[i] for i in dict.fromkeys((one.first, one.last))]
        text += f" ({' to '.join(f'{path.parent.name}/{path.name}' for path in paths)})"
    return f"{text} ({_around(one.place_xyz, quality)})"


def _around(place_xyz: tuple[float, ...], quality: RecordingQuality) -> str:
    return "around " + ", ".join(f"{'xyz'[j]}={place_xyz[j]:.1f}" for j in quality.axes)


def _row(one: Stretch) -> dict[str, Any]:
    """A stretch, with null for what is infinite."""
    return {k: finite_or_none(round(v, 4)) if isinstance(v, float) else v for k, v in asdict(one).items()}
