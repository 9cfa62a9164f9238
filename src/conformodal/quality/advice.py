"""Findings about a recording as text and as JSON, with advice on what to record next."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Any

import numpy as np

from conformodal.core.words import counted, finite_or_none, listed
from conformodal.localizer.region_rules import EvidenceType

from .examining import RecordingQuality
from .guarantee import N_NEW, EvidenceGuarantee
from .place_ambiguity import AmbiguousStretch
from .settings import QUALITY
from .view_coverage import Stretch

WHERE = {
    EvidenceType.GLOBAL: "in all images",
    EvidenceType.UNMATCHED: "where landmarks recognise no place",
    EvidenceType.LANDMARKS: "where landmarks recognise the place",
    EvidenceType.DISTURBED: "where images are blurred, dark, bright or noisy as none in training",
}
_DIGITS = 4


def record_next(found: RecordingQuality) -> list[str]:
    """What to record or train on next, the most valuable first; empty where nothing is missing."""
    recorded = [its for its in found.guarantees if its.evidence is not EvidenceType.DISTURBED]  # those are made
    lines = [_more_units(guarantee) for guarantee in recorded if not guarantee.finite and guarantee.n_frames]
    if found.coverage is not None:
        # most errors are to be expected in long stretches far from everything known
        for describe, stretches in ((_cover, found.coverage.sparse), (_slow_down, found.coverage.fast)):
            most = sorted(stretches, key=lambda one: -one.change * (one.last - one.first + 1))
            lines += [describe(one, found) for one in most]
    if found.ambiguity is not None:
        lines += [_tell_apart(one, found) for one in sorted(found.ambiguity.stretches, key=lambda o: -o.n_frames)]
    more = len(lines) - QUALITY.most_advice
    return lines if more <= 0 else [*lines[: QUALITY.most_advice], f"metrics.json lists {more} more such stretches."]


def _frames(first: int, last: int, found: RecordingQuality) -> str:
    """A stretch by its frames, and by their files too if there are several recordings."""
    text = f"frame {first}" if first == last else f"frames {first} to {last}"
    if len(np.unique(found.sequence.recording)) > 1:
        paths = [found.sequence.image_paths[i] for i in dict.fromkeys((first, last))]
        text += f" ({' to '.join(f'{path.parent.name}/{path.name}' for path in paths)})"
    return text


def _where(one: Stretch | AmbiguousStretch, found: RecordingQuality) -> str:
    """A stretch by its frames and its place."""
    place = ", ".join(f"{'xyz'[j]}={one.place_xyz[j]:.1f}" for j in found.axes)
    return f"{_frames(one.first, one.last, found)} (around {place})"


def _more_units(guarantee: EvidenceGuarantee) -> str:
    unbounded = f"regions are unbounded {WHERE[guarantee.evidence]}"
    if guarantee.n_needed is None:
        return (
            f"Record training data that reaches further: {unbounded}, because more than alpha = {guarantee.alpha:g} of "
            "the calibration frames lie beyond the training range."
        )
    what = "frames" if guarantee.by_frame else "stretches or recordings like these"
    return (
        f"Record more: {unbounded}. Calibrated on {_units(guarantee)}; alpha = {guarantee.alpha:g} takes "
        f"{guarantee.n_needed} {what}."
    )


def _cover(one: Stretch, found: RecordingQuality) -> str:
    where = _where(one, found)
    if not isfinite(one.distance_m):
        return f"Train on {where}: nothing is known."
    number = int(found.known_names[one.nearest])
    known = f" (known frame {number})" if number >= 0 else ""
    return (
        f"Train on {where} or a recording of the same stretch: the nearest known view is {one.distance_m:.2f} m and "
        f"{one.angle_deg:.0f} degrees away{known}."
    )


def _slow_down(one: Stretch, found: RecordingQuality) -> str:
    return (
        f"Move and turn more slowly in {_where(one, found)}, or record more views there: up to {one.distance_m:.2f} m "
        f"and {one.angle_deg:.0f} degrees per frame."
    )


def _tell_apart(one: AmbiguousStretch, found: RecordingQuality) -> str:
    runs = [(int(found.known_names[a]), int(found.known_names[b])) for a, b in one.alike]
    apart = [_frames(a, b, found) for a, b in runs if 0 <= a <= b and (b < one.first or a > one.last)]
    others = f" and {listed(apart)}" if apart else ""
    return (
        f"Places look alike: {_where(one, found)}{others}. Record them again with more in view that tells them apart, "
        "or the way from one to the other in one piece."
    )


def _limit(share: float, found: RecordingQuality) -> str:
    """A share of the view, also in degrees and metres."""
    turn = share * found.scale.fov_rad
    return (
        f"{100 * share:.0f} % of the field of view, {np.degrees(turn):.1f} degrees or "
        f"{turn * found.scale.depth_m:.2f} m"
    )


def describe_quality(found: RecordingQuality) -> list[str]:
    """The findings in short."""
    lines = []
    coverage, places = found.coverage, found.ambiguity
    if coverage is not None:
        n_unknown, n_sparse = int((~found.known).sum()), int(coverage.sparse_frames.sum())
        if n_unknown:  # known frames cover themselves
            lines.append(
                f"sparsely covered (the nearest known view differs by more than {_limit(QUALITY.sparse, found)}): "
                f"{n_sparse} of {counted(n_unknown, 'frame')} that the model was not trained on"
            )
        fast = counted(len(coverage.fast), "stretch", "stretches") if coverage.fast else "nowhere"
        lines.append(f"fast motion (neighbouring frames differ by more than {_limit(QUALITY.fast, found)}): {fast}")
    if places is not None:
        n_several, frames = (places.n_places > 1).sum(), counted(len(places.frames), "frame")
        text = f"ambiguous: {n_several} of {frames} that the model has not seen"
        bounded = places.n_places[places.n_places > 0]
        if bounded.size:
            text += f"; {bounded.mean():.2f} known places per region on average, {bounded.max()} at most"
        lines.append(f"{text}; unknown place: {places.n_unknown}" if places.n_unknown else text)
    return lines + [describe_guarantee(guarantee) for guarantee in found.guarantees]


def describe_guarantee(guarantee: EvidenceGuarantee) -> str:
    """What the regions of one evidence type can guarantee."""
    text = f"regions {WHERE[guarantee.evidence]}: "
    if not guarantee.n_frames:
        return f"{text}unbounded, no calibration frame"
    text += f"calibrated on {_units(guarantee)}"
    text += "" if guarantee.finite else f", unbounded at alpha = {guarantee.alpha:g}"
    text += (
        f", bounded from alpha = {guarantee.least_alpha_shown:g}" if guarantee.least_alpha < 1 else ", never bounded"
    )
    if guarantee.band is not None and guarantee.finite:
        low, high = guarantee.band
        text += f"; covers {low:.3f} to {high:.3f} of {N_NEW} new frames at alpha = {guarantee.alpha:g} (99 % band)"
    return text


def _units(guarantee: EvidenceGuarantee) -> str:
    """The frames of an evidence type that calibrate, and their weight."""
    frames = counted(guarantee.n_frames, "frame")
    if guarantee.by_frame:
        return frames
    units = counted(guarantee.n_units, "stretch or recording", "stretches or recordings")
    return f"{frames} of {units} (weight {guarantee.weight:.1f}, at least {guarantee.weight_needed:g} needed)"


def quality_record(found: RecordingQuality) -> dict[str, Any]:
    """The findings for ``metrics.json``."""
    record: dict[str, Any] = {
        "summary": describe_quality(found),
        "record_next": record_next(found),
        "settings": asdict(QUALITY),
        "n_frames": len(found.sequence),
        "n_with_pose": len(found.posed),
        "n_known": int(found.known.sum()),
        "guarantees": [
            {
                **asdict(guarantee),
                "evidence": guarantee.evidence.name.lower(),
                "least_alpha": guarantee.least_alpha_shown if guarantee.least_alpha < 1 else None,
            }
            for guarantee in found.guarantees
        ],
    }
    coverage, places = found.coverage, found.ambiguity
    if coverage is not None:
        fov_deg = float(np.degrees(found.scale.fov_rad))
        record["scale"] = {"depth_m": found.scale.depth_m, "field_of_view_deg": fov_deg}
        record |= {name: [_stretch(one, found) for one in getattr(coverage, name)] for name in ("sparse", "fast")}
        record["n_sparse_frames"] = int(coverage.sparse_frames.sum())
    if places is not None:
        record["ambiguity"] = {
            "n_looked_at": len(places.frames),
            "n_ambiguous": int((places.n_places > 1).sum()),
            "n_unknown": places.n_unknown,
            "stretches": [_stretch(one, found) for one in places.stretches],
        }
    return record


def _stretch(one: Stretch | AmbiguousStretch, found: RecordingQuality) -> dict[str, Any]:
    """With the files of its ends, the recording's own numbers of known frames, and null for what is infinite."""
    plain = asdict(one)
    plain |= {key: finite_or_none(round(value, _DIGITS)) for key, value in plain.items() if isinstance(value, float)}
    if isinstance(one, Stretch):
        plain["nearest"] = _number_of(one.nearest, found)
    else:
        plain["alike"] = [[_number_of(a, found), _number_of(b, found)] for a, b in one.alike]
    files = found.sequence.image_paths
    plain |= {"first_image": files[one.first].name, "last_image": files[one.last].name}
    return {**plain, "place_xyz": [finite_or_none(round(value, _DIGITS)) for value in one.place_xyz]}


def _number_of(known: int, found: RecordingQuality) -> int | None:
    """Number in the recording of a known frame; null where the recording lacks it."""
    number = int(found.known_names[known]) if known >= 0 else -1
    return number if number >= 0 else None
