"""What is measured in frames without a network: relative motions, local features."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.parallel import in_threads, raise_if_cancelled
from conformodal.core.progress import Progress
from conformodal.features.local import Detector, LocalFeatures, extract_local_features
from conformodal.geometry import RelativeMotion
from conformodal.io import ImageError, Recording
from conformodal.io.decoding import grey_image

from .tracker import MotionFrontEnd, affine_flow

_SEGMENT = 100  # frames that are looked at one after the other; the last of a segment leads in to the next


class FrontEndOutputs(NamedTuple):
    """What one look at frames tells, by their indices."""

    motions: dict[int, RelativeMotion | None]  # from the frame before, among those looked at; None where there is none
    features: dict[int, LocalFeatures]  # with their flow; empty without a detector


def run_front_end(
    sequence: Recording, frames: IntArray, detector: Detector | None, progress: Progress | None = None, *, motions: bool
) -> FrontEndOutputs:
    """Look once at each of `frames`, increasing indices in a sequence, and follow corners through all between them.

    `motions` says whether these are wanted: flows need none.
    """

    def look_at(rows: IntArray) -> FrontEndOutputs:
        looks, front_end, before = FrontEndOutputs({}, {}), MotionFrontEnd(sequence.camera), -1
        start = int(frames[rows[0] - 1]) if rows[0] else max(int(frames[0]) - 1, 0)
        for i in range(start, int(frames[rows[-1]]) + 1):
            raise_if_cancelled()
            if before >= 0 and sequence.recording[i] != sequence.recording[before]:
                front_end.reset()
                before = -1
            try:
                grey = grey_image(sequence.image(i))
            except ImageError:
                if i in wanted:
                    raise
                continue
            if not motions:
                front_end.tracker.advance(grey)
                front_end.tracker.mark()
            elif i in wanted or before < 0:
                looks.motions[i] = front_end.measure(grey)
            else:
                front_end.track_only(grey)
            if i in wanted and detector is not None:
                seconds = float(sequence.timestamps_s[i] - sequence.timestamps_s[before]) if before >= 0 else 0.0
                flow = affine_flow(front_end.tracker.step, seconds, sequence.camera)
                looks.features[i] = extract_local_features(grey, sequence.camera, detector)._replace(flow=flow)
            before = i
        return looks

    wanted = set(frames.tolist())
    segments = [np.arange(len(frames))[k : k + _SEGMENT] for k in range(0, len(frames), _SEGMENT)]
    looks = in_threads(look_at, segments, progress)[::-1]  # what leads in to a segment is of the one before
    every_motion = {i: motion for look in looks for i, motion in look.motions.items()}
    return FrontEndOutputs(every_motion, {i: features for look in looks for i, features in look.features.items()})


def frame_features(sequence: Recording, i: int, detector: Detector) -> LocalFeatures:
    """Local features of a frame of a sequence, with its flow from the frame before."""
    return run_front_end(sequence, np.array([i]), detector, motions=False).features[i]


def turned_features(
    sequence: Recording, i: int, detector: Detector, turn_rad: float, upright: LocalFeatures
) -> LocalFeatures:
    """Local features of a frame of a sequence that is turned before; flow and quality are those found `upright`."""
    turned = extract_local_features(sequence.image(i), sequence.camera, detector, turn_rad)
    return turned._replace(flow=upright.flow, quality=upright.quality)
