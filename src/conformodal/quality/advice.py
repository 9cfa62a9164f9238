"""What was found of a recording as text, with advice on what to record next, and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted, listed
from conformodal.datasets import Sequence
from conformodal.model.region_rules import EvidenceType, Sharing

from .examining import RecordingQuality
from .guarantee import N_NEW, EvidenceGuarantee
from .place_ambiguity import AmbiguousStretch
from .settings import QUALITY
from .view_coverage import TILTED, FastStretch, SparseStretch

WHERE = {
    EvidenceType.GLOBAL: "where local features are not matched",
    EvidenceType.UNMATCHED: "where landmarks recognise no place",
    EvidenceType.LANDMARKS: "where landmarks recognise the place",
}
_SHARING = {
    Sharing.WIDER: "one evidence type has just enough frames: its thresholds are the larger of its own and the shared",
    Sharing.SHARED: "one evidence type has too few frames: both share thresholds and one guarantee",
}
_DIGITS = 4


class Names:
    """Names of frames and places of a recording.

    A frame is named by its file too if there are several recordings, and a place by the two axes along which the
    positions (n, 3) spread most.
    """

    def __init__(self, sequence: Sequence, positions_xyz: FloatArray | None) -> None:
        self._sequence = sequence
        self._several = len(np.unique(sequence.recording)) > 1
        extent = np.zeros(3) if positions_xyz is None else np.ptp(positions_xyz, axis=0)
        first, second = sorted(np.argsort(-extent, kind="stable")[:2].tolist())
        self.axes: tuple[int, int] = (first, second)

    def frames(self, first: int, last: int) -> str:
        """A stretch."""
        text = f"frame {first}" if first == last else f"frames {first} to {last}"
        if self._several:
            paths = [self._sequence.image_paths[i] for i in dict.fromkeys((first, last))]
            text += f" ({' to '.join(f'{path.parent.name}/{path.name}' for path in paths)})"
        return text

    def stretch(self, one: SparseStretch | FastStretch | AmbiguousStretch) -> str:
        """Its frames and place."""
        place = ", ".join(f"{'xyz'[j]}={one.place_xyz[j]:.1f}" for j in self.axes)
        return f"{self.frames(one.first, one.last)} (around {place})"


def names_of(found: RecordingQuality, sequence: Sequence) -> Names:
    """Names of its frames and places."""
    return Names(sequence, None if found.poses is None else found.poses.positions_xyz)


def record_next(found: RecordingQuality, names: Names) -> list[str]:
    """What to record or train on next, the most valuable first; empty where nothing is missing."""
    lines = [_more_units(guarantee) for guarantee in found.guarantees if not guarantee.finite and guarantee.n_frames]
    if found.coverage is not None:
        # most errors are to be expected in long stretches far from everything known
        sparse = sorted(found.coverage.sparse, key=lambda one: -(one.way + one.change))
        lines += [_cover(one, names, found) for one in sparse]
        for fast in sorted(found.coverage.fast, key=lambda one: -one.change * (one.last - one.first)):
            step = f"up to {fast.distance_m:.2f} m and {fast.angle_deg:.0f} degrees per frame"
            lines.append(f"{'Turn' if fast.turning else 'Move'} more slowly in {names.stretch(fast)}: {step}.")
    if found.ambiguity is not None:
        lines += [
            _tell_apart(one, names, found) for one in sorted(found.ambiguity.stretches, key=lambda o: -o.n_frames)
        ]
    more = len(lines) - QUALITY.most_advice
    return lines if more <= 0 else [*lines[: QUALITY.most_advice], f"metrics.json lists {more} more such stretches."]


def _more_units(guarantee: EvidenceGuarantee) -> str:
    unbounded = f"regions are unbounded {WHERE[guarantee.evidence]}"
    if guarantee.n_needed is None:
        return (
            f"Record training data that reaches further: {unbounded}, because more than alpha = {guarantee.alpha:g} of "
            "the calibration frames lie beyond the training range."
        )
    what = "frames" if guarantee.by_frame else "stretches or recordings like these"
    both = " of both evidence types together" if guarantee.sharing is Sharing.SHARED else ""
    return (
        f"Record more: {unbounded}. Calibrated on {describe_units(guarantee)}; alpha = {guarantee.alpha:g} takes "
        f"{guarantee.n_needed} {what}{both}."
    )


def _cover(one: SparseStretch, names: Names, found: RecordingQuality) -> str:
    where = names.stretch(one)
    if not isfinite(one.distance_m):
        return f"Train on {where}: nothing is known."
    away = f"the nearest known view is {one.distance_m:.2f} m and {one.angle_deg:.0f} degrees away"
    if one.between:
        return f"Record more views along {where}: on the way, {away}."
    number = int(found.known_names[one.nearest])
    turned = one.turned if one.turned in ("", TILTED) else f"turned {one.turned}"
    moves = [text for text in (turned, f"moved {one.moved}" if one.moved else "") if text]
    details = [f"known frame {number}"] if number >= 0 else []
    details += [f"from there the camera is {listed(moves)}"] if moves else []
    more = f" ({'; '.join(details)})" if details else ""
    return f"Train on {where} or a recording of the same stretch: {away}{more}."


def _tell_apart(one: AmbiguousStretch, names: Names, found: RecordingQuality) -> str:
    runs = [(int(found.known_names[a]), int(found.known_names[b])) for a, b in one.alike]
    runs = [(a, b) for a, b in runs if 0 <= a <= b]
    apart = [names.frames(a, b) for a, b in runs if b < one.first or a > one.last]
    tells = "with more in view that tells them apart"
    if runs and not apart:
        return f"Places look alike in {names.stretch(one)}: record them again {tells}."
    others = listed(apart) if apart else "other places"
    return (
        f"Places look alike: {names.stretch(one)} and {others}. Record the way from one to the other in one piece, and "
        f"each {tells}."
    )


def describe_quality(found: RecordingQuality) -> list[str]:
    """The findings in short."""
    lines = []
    coverage = found.coverage
    if coverage is not None:
        n_gaps = sum(one.between for one in coverage.sparse)
        gaps = f"{counted(n_gaps, 'gap') if n_gaps else 'no gap'} between"
        limit = f"differs by more than {100 * QUALITY.sparse:.0f} % of the field of view"
        if found.scale is not None:
            turn = QUALITY.sparse * found.scale.fov_rad
            limit += f", {np.degrees(turn):.1f} degrees or {turn * found.scale.depth_m:.2f} m"
        n_unknown, n_sparse = int((~found.known).sum()), int(coverage.sparse_frames.sum())
        if n_unknown:
            stretches = counted(len(coverage.sparse) - n_gaps, "stretch", "stretches")
            lines.append(
                f"sparsely covered (the nearest known view {limit}): {n_sparse or 'none'} of "
                f"{counted(n_unknown, 'frame')} that the model was not trained on"
                f"{f', in {stretches}' if n_sparse else ''}; {gaps} frames"
            )
        else:  # each frame covers itself
            n = counted(len(found.known), "frame")
            lines.append(f"{gaps} the {n} (a gap: halfway, the nearest known view {limit})")
        fast = counted(len(coverage.fast), "stretch", "stretches") if coverage.fast else "nowhere"
        lines.append(f"fast motion (more than {100 * QUALITY.fast:.0f} % of the field of view per frame): {fast}")
    if found.ambiguity is not None:
        lines += _describe_ambiguity(found)
    return lines + [describe_guarantee(guarantee) for guarantee in found.guarantees]


def _describe_ambiguity(found: RecordingQuality) -> list[str]:
    places = found.ambiguity
    assert places is not None
    n_several, frames = (places.n_places > 1).sum(), counted(len(places.frames), "frame")
    text = f"ambiguous: {n_several} of {frames} that the model has not seen"
    bounded = places.n_places[places.n_places > 0]
    if bounded.size:
        text += f"; {bounded.mean():.2f} known places per region on average, {bounded.max()} at most"
    if places.n_unknown:
        text += f"; unknown place: {places.n_unknown}"
    lines = [text]
    if found.errors_m is not None and found.coverage is not None:
        sparse = found.coverage.sparse_frames[np.searchsorted(found.posed, places.frames)]
        if sparse.any() and not sparse.all():
            medians = [f"{np.median(found.errors_m[rows]):.3f} m" for rows in (sparse, ~sparse)]
            lines.append(
                f"median position error of single frames: {medians[0]} where sparsely covered, {medians[1]} elsewhere"
            )
    return lines


def describe_guarantee(guarantee: EvidenceGuarantee) -> str:
    """What the regions of one evidence type can guarantee."""
    text = f"regions {WHERE[guarantee.evidence]}: "
    if not guarantee.n_frames and guarantee.sharing is Sharing.OWN:
        return f"{text}unbounded, no calibration frame"
    text += f"calibrated on {describe_units(guarantee)}"
    if guarantee.sharing is not Sharing.OWN:
        text += f" (thresholds: {guarantee.sharing})"
    text += (
        f", bounded from alpha = {guarantee.least_alpha_shown:g}" if guarantee.least_alpha < 1 else ", never bounded"
    )
    if guarantee.band is not None and guarantee.finite:
        low, high = guarantee.band
        text += f"; covers {low:.3f} to {high:.3f} of {N_NEW} new frames at alpha = {guarantee.alpha:g} (99 % band)"
    return text


def describe_units(guarantee: EvidenceGuarantee) -> str:
    """The frames of an evidence type that calibrate, and their weight."""
    frames = counted(guarantee.n_frames, "frame")
    if guarantee.by_frame:
        return frames
    units = counted(guarantee.n_units, "stretch or recording", "stretches or recordings")
    return f"{frames} of {units} (weight {guarantee.weight:.1f}, at least {guarantee.weight_needed:g} needed)"


def describe_unbounded(guarantees: list[EvidenceGuarantee]) -> list[str]:
    """Evidence types whose region is unbounded in some target or that share thresholds, with the reason."""
    lines: list[str] = []
    for one in guarantees:
        where = WHERE[one.evidence]
        if one.finite:
            lines += [_SHARING[one.sharing]] if one.sharing in _SHARING else []
        elif not one.n_frames:
            lines.append(f"the region is unbounded {where}: no calibration frame")
        else:
            lines.append(
                f"the region is unbounded in some target {where}: {describe_units(one)} within the training range are "
                f"too few for alpha = {one.alpha:g}. Take a larger alpha, or more "
                f"{'frames' if one.by_frame else 'recordings'}."
            )
    return list(dict.fromkeys(lines))  # types that share thresholds say so once


def quality_record(found: RecordingQuality, sequence: Sequence, *, short: bool = False) -> dict[str, Any]:
    """The findings for ``metrics.json``; `short` leaves out numbers of single frames."""
    record: dict[str, Any] = {
        "summary": describe_quality(found),
        "record_next": record_next(found, names_of(found, sequence)),
        "settings": asdict(QUALITY),
        "n_frames": len(sequence),
        "n_with_pose": len(found.posed),
        "n_known": int(found.known.sum()),
        "guarantees": [
            {
                **asdict(guarantee),
                "evidence": guarantee.evidence.name.lower(),
                "least_alpha": guarantee.least_alpha_shown if guarantee.least_alpha < 1 else None,
                "band": None if guarantee.band is None else list(guarantee.band),
            }
            for guarantee in found.guarantees
        ],
    }
    coverage, places = found.coverage, found.ambiguity
    if coverage is not None and found.scale is not None:
        record["scale"] = {"depth_m": found.scale.depth_m, "field_of_view_deg": float(np.degrees(found.scale.fov_rad))}
        record["sparse"] = [
            {**_stretch(one, sequence), "nearest": _number_of(found, one.nearest)} for one in coverage.sparse
        ]
        record["fast"] = [_stretch(one, sequence) for one in coverage.fast]
        record["n_sparse_frames"] = int(coverage.sparse_frames.sum())
        if not short:
            record["change"] = [_finite(change) for change in coverage.change.tolist()]
    if places is not None:
        record["ambiguity"] = {
            "n_looked_at": len(places.frames),
            "n_ambiguous": int((places.n_places > 1).sum()),
            "n_unknown": places.n_unknown,
            "mean_intervals": places.mean_intervals,
            "stretches": [
                {
                    **_stretch(one, sequence),
                    "alike": [[_number_of(found, a), _number_of(found, b)] for a, b in one.alike],
                }
                for one in places.stretches
            ],
        }
        if not short:
            record["ambiguity"] |= {"frames": places.frames.tolist(), "n_places": places.n_places.tolist()}
    return record


def _stretch(one: SparseStretch | FastStretch | AmbiguousStretch, sequence: Sequence) -> dict[str, Any]:
    """With the files of its ends, and null for what is infinite."""
    plain = {key: _finite(value) if isinstance(value, float) else value for key, value in asdict(one).items()}
    ends = {"first_image": sequence.image_paths[one.first].name, "last_image": sequence.image_paths[one.last].name}
    return {**plain, **ends, "place_xyz": [_finite(value) for value in one.place_xyz]}


def _number_of(found: RecordingQuality, known: int) -> int | None:
    """Number in the recording of a known frame; null where the recording lacks it."""
    number = int(found.known_names[known]) if known >= 0 else -1
    return number if number >= 0 else None


def _finite(value: float) -> float | None:
    return round(value, _DIGITS) if isfinite(value) else None
