"""What is measured in frames without a network: relative motions, submaps, local features."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray, UInt8Array
from conformodal.core.parallel import raise_if_cancelled
from conformodal.core.progress import StageProgress
from conformodal.features.local import LocalFeatures, extract_local_features
from conformodal.geometry import RelativeMotion, Submap
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import ImageError, Recording
from conformodal.io.decoding import grey_image

from .submaps import build_submaps
from .tracker import LONGEST_FLOW_S, Corners, CornerTracker, FrontEnd, MotionFrontEnd, affine_flow


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """Motion between the answered frames of a sequence."""

    # by frame: the motion from the answered frame before; None for the first of a recording
    motions: dict[int, RelativeMotion | None]
    unreadable: dict[int, str]  # frames that could not be decoded, and why
    submaps: list[Submap] = field(default_factory=list)  # of the answered frames; each lies within one recording
    # by frame; empty where they were not asked for
    local_features: dict[int, LocalFeatures] = field(default_factory=dict)


def measure_motions(
    sequence: Recording,
    frames: IntArray,
    progress: StageProgress | None = None,
    *,
    front_end: FrontEnd | None = None,
    local: bool = True,
) -> MotionRecord:
    """Relative motions of `frames`, increasing indices in a sequence, followed through all frames between them.

    `front_end` measures them, by default a :class:`~conformodal.tracking.tracker.MotionFrontEnd`. With `local`,
    submaps are built and local features extracted too.
    """
    answer, times = set(frames.tolist()), sequence.timestamps_s
    front_end = front_end or MotionFrontEnd(sequence.camera)
    record = MotionRecord({}, {})
    recording, before = None, 0  # the last frame that could be read
    corners: dict[int, Corners] = {}
    span = range(int(frames.min()), int(frames.max()) + 1) if frames.size else range(0)
    for done, i in enumerate(span, start=1):
        raise_if_cancelled()
        if sequence.recording[i] != recording:
            _append_submaps(record, corners, sequence)
            corners = {}
            front_end.reset()
            recording = sequence.recording[i]
        try:
            image = sequence.image(i)
        except ImageError as exc:
            if i in answer:
                record.unreadable[i] = str(exc)
            continue
        if i in answer:
            record.motions[i] = front_end.measure(image)
            if local:
                corners[i] = front_end.corners
                flow = affine_flow(front_end.tracker.step, float(times[i] - times[before]), sequence.camera)
                record.local_features[i] = extract_local_features(image, sequence.camera)._replace(flow=flow)
        else:
            front_end.track_only(image)
        before = i
        if progress is not None:
            progress("motion", done, len(span))
    _append_submaps(record, corners, sequence)
    return record


def _append_submaps(record: MotionRecord, corners: dict[int, Corners], sequence: Recording) -> None:
    """Add the submaps of the frames of one recording, by whose numbers `corners` are."""
    frames = np.array(list(corners), dtype=np.int64)
    submaps = build_submaps(list(corners.values()), sequence.camera)
    record.submaps.extend(replace(submap, frames=frames[submap.frames]) for submap in submaps)


def _flow_of(sequence: Recording, i: int, image: UInt8Array) -> FloatArray:
    """The flow (2, 3) in a frame of a sequence, its `image`, from the last frame before it that can be read."""
    for before in range(i - 1, -1, -1):
        seconds = float(sequence.timestamps_s[i] - sequence.timestamps_s[before])
        if not 0 < seconds < LONGEST_FLOW_S or sequence.recording[i] != sequence.recording[before]:
            break
        tracker = CornerTracker()
        try:
            tracker.advance(grey_image(sequence.image(before)))
        except ImageError:
            continue
        tracker.mark()
        tracker.advance(grey_image(image))
        return affine_flow(tracker.step, seconds, sequence.camera)
    return NO_FLOW


def frame_features(sequence: Recording, i: int) -> LocalFeatures:
    """Local features of a frame of a sequence, with its flow."""
    image = sequence.image(i)
    return extract_local_features(image, sequence.camera)._replace(flow=_flow_of(sequence, i, image))
