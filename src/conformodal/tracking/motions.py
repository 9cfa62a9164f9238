"""What is measured in frames without a network: relative motions, local features."""

from __future__ import annotations

from conformodal.core.arrays import FloatArray, IntArray, UInt8Array
from conformodal.core.parallel import raise_if_cancelled
from conformodal.core.progress import StageProgress
from conformodal.features.local import Detector, LocalFeatures, extract_local_features
from conformodal.geometry import RelativeMotion
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import ImageError, Recording
from conformodal.io.decoding import grey_image

from .tracker import LONGEST_FLOW_S, CornerTracker, MotionFrontEnd, affine_flow


def measure_motions(
    sequence: Recording, frames: IntArray, progress: StageProgress | None = None
) -> dict[int, RelativeMotion | None]:
    """Motion to each of `frames`, increasing indices in a sequence, from the one before; None where there is none.

    Corners are followed through all frames between them.
    """
    answer, front_end, recording = set(frames.tolist()), MotionFrontEnd(sequence.camera), None
    motions: dict[int, RelativeMotion | None] = {}
    span = range(int(frames.min()), int(frames.max()) + 1) if frames.size else range(0)
    for done, i in enumerate(span, start=1):
        raise_if_cancelled()
        if sequence.recording[i] != recording:
            front_end.reset()
            recording = sequence.recording[i]
        if i in answer:
            motions[i] = front_end.measure(sequence.image(i))
        else:
            front_end.track_only(sequence.image(i))
        if progress is not None:
            progress("motion", done, len(span))
    return motions


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


def frame_features(sequence: Recording, i: int, detector: Detector) -> LocalFeatures:
    """Local features of a frame of a sequence, with its flow."""
    image = sequence.image(i)
    return extract_local_features(image, sequence.camera, detector)._replace(flow=_flow_of(sequence, i, image))
