"""What is said of a recording: plain sentences, and what to record or train on next, the most valuable first."""

from __future__ import annotations

from math import isfinite

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted, listed, noun_for
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


class Names:
    """How frames and places of a recording are called.

    Parameters
    ----------
    sequence
        Its frames; where it has several recordings, a frame is named by its file too.
    positions_xyz
        (n, 3) of all frames with a pose: a place is named by the two axes along which they spread most.
    """

    def __init__(self, sequence: Sequence, positions_xyz: FloatArray | None) -> None:
        self._sequence = sequence
        self._several = len(np.unique(sequence.recording)) > 1
        extent = np.zeros(3) if positions_xyz is None else np.ptp(positions_xyz, axis=0)
        self.axes: tuple[int, int] = (0, 1) if positions_xyz is None else _plan_axes(extent)

    def frames(self, first: int, last: int) -> str:
        """A stretch."""
        if not self._several:
            return f"frame {first}" if first == last else f"frames {first} to {last}"
        if first == last:
            return f"frame {first} ({self._file(first)})"
        return f"frames {first} to {last} ({self._file(first)} to {self._file(last)})"

    def place(self, xyz: tuple[float, float, float]) -> str:
        """A place, by its two widest axes."""
        return ", ".join(f"{'xyz'[j]}={xyz[j]:.1f}" for j in self.axes)

    def _file(self, frame: int) -> str:
        path = self._sequence.image_paths[frame]
        return f"{path.parent.name}/{path.name}"


def _plan_axes(extent: FloatArray) -> tuple[int, int]:
    """The two axes along which a path spreads most, in order."""
    first, second = sorted(np.argsort(-extent, kind="stable")[:2].tolist())
    return first, second


def record_next(found: RecordingQuality, names: Names) -> list[str]:
    """What to record or train on next, the most valuable first; empty where nothing is missing."""
    said = [_more_units(guarantee) for guarantee in found.guarantees if not guarantee.finite and guarantee.n_frames]
    if found.coverage is not None:
        # far from everything known, and long: that is where most errors are to expect
        sparse = sorted(found.coverage.sparse, key=lambda one: -(one.way + one.change))
        said += [_again(one, names, found) for one in sparse]
        fast = sorted(found.coverage.fast, key=lambda one: -one.change * (one.last - one.first))
        said += [_slower(one, names) for one in fast]
    if found.ambiguity is not None:
        alike = sorted(found.ambiguity.stretches, key=lambda one: -one.n_frames)
        said += [_apart(one, names, found) for one in alike]
    more = len(said) - QUALITY.most_advice
    return said if more <= 0 else [*said[: QUALITY.most_advice], f"metrics.json lists {more} more such stretches."]


def describe_quality(found: RecordingQuality) -> list[str]:
    """The findings in short."""
    said = []
    coverage = found.coverage
    if coverage is not None:
        gaps = sum(one.between for one in coverage.sparse)
        between = f"{counted(gaps, 'gap') if gaps else 'no gap'} between "
        far = f"differs by more than {100 * QUALITY.sparse:.0f} % of the field of view{_as_step(found)}"
        n_unknown, n_sparse = int((~found.known).sum()), int(coverage.sparse_frames.sum())
        if n_unknown:
            stretches = f", in {counted(len(coverage.sparse) - gaps, 'stretch', 'stretches')}" if n_sparse else ""
            said.append(
                f"sparsely covered: {n_sparse or 'none'} of the {counted(n_unknown, 'frame')} that the model was not "
                f"trained on{stretches}; {between}frames (sparsely covered: the nearest view that it was trained on "
                f"{far})"
            )
        else:  # each frame covers itself: only the ways between them can be sparse
            said.append(
                f"{between}the {counted(len(found.known), 'frame')}, all of them taken as known (a gap: halfway, the "
                f"nearest known view {far})"
            )
        said.append(
            f"turning or moving fast (more than {100 * QUALITY.fast:.0f} % of the field of view from frame to frame): "
            + (counted(len(coverage.fast), "stretch", "stretches") if coverage.fast else "nowhere")
        )
    if found.ambiguity is not None:
        said += _describe_ambiguity(found)
    return said + [describe_guarantee(guarantee) for guarantee in found.guarantees]


def _as_step(found: RecordingQuality) -> str:
    """The limit as a turn and as a step."""
    if found.scale is None:
        return ""
    turn = QUALITY.sparse * found.scale.fov_rad
    return f", {np.degrees(turn):.1f} degrees or {turn * found.scale.depth_m:.2f} m"


def _describe_ambiguity(found: RecordingQuality) -> list[str]:
    places = found.ambiguity
    assert places is not None
    n, several = len(places.frames), int((places.n_places > 1).sum())
    bounded = places.n_places[places.n_places > 0]
    held = (
        f"; a region holds {bounded.mean():.2f} known places on average, {bounded.max()} at most"
        if bounded.size
        else ""
    )
    said = [f"ambiguous: {several} of {counted(n, 'frame')} that the model has not seen{held}"]
    if places.n_unknown:
        said[0] += f"; {places.n_unknown} show no place that is known"
    if found.errors_m is not None and found.coverage is not None:
        sparse = found.coverage.sparse_frames[np.searchsorted(found.posed, places.frames)]
        if sparse.any() and not sparse.all():
            said.append(
                "median position error of these frames, each answered by itself: "
                f"{np.median(found.errors_m[sparse]):.3f} m where they are sparsely covered, "
                f"{np.median(found.errors_m[~sparse]):.3f} m elsewhere"
            )
    return said


def describe_guarantee(guarantee: EvidenceGuarantee) -> str:
    """What the regions of one evidence type can guarantee."""
    where = f"regions {WHERE[guarantee.evidence]}"
    if not guarantee.n_frames and guarantee.sharing is Sharing.OWN:
        return f"{where}: no frame calibrates them, they are unbounded"
    said = f"{where}: {describe_units(guarantee)} {noun_for(guarantee.n_frames, 'calibrates', 'calibrate')} them"
    if guarantee.sharing is not Sharing.OWN:
        said += f" (thresholds: {guarantee.sharing})"
    bounded = guarantee.least_alpha < 1
    said += f", finite from alpha = {guarantee.least_alpha_shown:g}" if bounded else ", finite at no alpha"
    if guarantee.band is not None and guarantee.finite:
        low, high = guarantee.band
        said += (
            f"; of {N_NEW} new frames {low:.3f} to {high:.3f} are covered at alpha = {guarantee.alpha:g} (99 % band)"
        )
    return said


def describe_units(guarantee: EvidenceGuarantee) -> str:
    """The frames of an evidence type that calibrate, and what they weigh."""
    frames = counted(guarantee.n_frames, "frame")
    if guarantee.by_frame:
        return frames
    units = counted(guarantee.n_units, "stretch or recording", "stretches or recordings")
    return f"{frames} of {units}, which weigh {guarantee.weight:.1f} whole ones,"


def describe_sharing(guarantee: EvidenceGuarantee) -> str:
    """Whose thresholds an evidence type has that shares them, and what that guarantees."""
    if guarantee.sharing is Sharing.WIDER:
        return (
            "one evidence type is at the limit of too few frames: its thresholds are the larger of its own and those "
            "shared with the other"
        )
    return (
        "one evidence type has too few frames: images with and without a recognised place share thresholds, and the "
        "guarantee concerns both together"
    )


def _more_units(guarantee: EvidenceGuarantee) -> str:
    where, alpha = WHERE[guarantee.evidence], guarantee.alpha
    shared = guarantee.sharing is Sharing.SHARED
    them = "them, together with those of the other evidence type," if shared else "them"
    if guarantee.n_needed is None:
        return (
            f"Record again with training data that reaches further: regions are unbounded {where}, because more than "
            f"alpha = {alpha:g} of the frames that calibrate {them} lie beyond the training range."
        )
    if guarantee.by_frame:
        return (
            f"Record more frames {where}: regions are unbounded there, because "
            f"{counted(guarantee.n_frames, 'frame')} {noun_for(guarantee.n_frames, 'calibrates', 'calibrate')} {them}; "
            f"alpha = {alpha:g} needs at least {guarantee.n_needed}{' in all' if shared else ''}."
        )
    return (
        f"Record more: regions are unbounded {where}. {describe_units(guarantee)} calibrate {them}; alpha = {alpha:g} "
        f"needs a weight of {guarantee.weight_needed:g}, which takes {guarantee.n_needed} stretches or recordings like "
        "these."
    )


def _again(one: SparseStretch, names: Names, found: RecordingQuality) -> str:
    if not isfinite(one.distance_m):
        return f"Train on {names.frames(one.first, one.last)} (around {names.place(one.place_xyz)}): nothing is known."
    gap = f"{one.distance_m:.2f} m and {one.angle_deg:.0f} degrees"
    if one.between:
        way = f"from {names.frames(one.first, one.first)} to {names.frames(one.last, one.last)}"
        denser = "" if one.last - one.first == 1 else " with more frames"
        return (
            f"Record the way {way} (around {names.place(one.place_xyz)}){denser}: between two of its frames the "
            f"nearest known view is {gap} away."
        )
    number = int(found.known_names[one.nearest])
    other = f"known frame {number}" if number >= 0 else "the nearest known frame"
    tilted = one.turned == TILTED
    they, are, look = ("it", "is", "looks") if one.first == one.last else ("they", "are", "look")
    turned = f"{are} tilted against {other}" if tilted else f"{look} further {one.turned}" if one.turned else ""
    how = listed([said for said in (turned, f"{are} taken from further {one.moved}" if one.moved else "") if said])
    ways = f"{they} {how}{'' if tilted else f' than {other}'}; " if how else ""
    return (
        f"Train on {names.frames(one.first, one.last)} (around {names.place(one.place_xyz)}) too, or on a recording of "
        f"the same stretch: {ways}the nearest known view is {gap} away."
    )


def _slower(one: FastStretch, names: Names) -> str:
    return (
        f"{'Turn' if one.turning else 'Move'} more slowly in {names.frames(one.first, one.last)} (around "
        f"{names.place(one.place_xyz)}): up to {one.distance_m:.2f} m and {one.angle_deg:.0f} degrees from "
        "one frame to the next."
    )


def _apart(one: AmbiguousStretch, names: Names, found: RecordingQuality) -> str:
    runs = [(int(found.known_names[a]), int(found.known_names[b])) for a, b in one.alike]
    runs = [(a, b) for a, b in runs if 0 <= a <= b]
    apart = [names.frames(a, b) for a, b in runs if b < one.first or a > one.last]
    stretch = f"F{names.frames(one.first, one.last)[1:]} (around {names.place(one.place_xyz)})"
    tells = "with more in view of what tells them apart"
    if runs and not apart:  # one stretch, in which views from several places look alike
        return f"{stretch} look like one another: record them again {tells}."
    look = "looks" if one.first == one.last else "look"
    return (
        f"{stretch} {look} like {listed(apart) if apart else 'other places'}: record the way from one to the other in "
        f"one piece, and record each {tells}."
    )
