"""What the frames of a whole sequence that are to be answered say without a network: motions, submaps, corners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from conformodal.datasets import ImageError, Sequence
from conformodal.motion import Corners, Described, FrontEnd, MotionFrontEnd, build_submaps, describe
from conformodal.poses import RelativeMotion, Submap

IntArray = npt.NDArray[np.int64]
Progress = Callable[[str, int, int], None]


def stage_of(progress: Progress | None, stage: str) -> Callable[[int, int], None] | None:
    """Progress of one stage: called with what is done and what is to be done in all."""
    return None if progress is None else lambda done, total: progress(stage, done, total)


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """Motion between the answered frames of a sequence.

    Attributes
    ----------
    motions
        By frame: the motion from the answered frame before; None for the first of a recording.
    unreadable
        Frames that could not be decoded, and why.
    submaps
        Of the answered frames; each lies within one recording.
    described
        By frame: what landmarks are recognised by.
    """

    motions: dict[int, RelativeMotion | None]
    unreadable: dict[int, str]
    submaps: list[Submap] = field(default_factory=list)
    described: dict[int, Described] = field(default_factory=dict)


def measure_motions(
    sequence: Sequence,
    frames: IntArray,
    progress: Progress | None = None,
    *,
    front_end: FrontEnd | None = None,
    landmarks: bool = True,
) -> MotionRecord:
    """Relative motions and submaps of `frames` of a sequence, followed through all frames between them.

    Parameters
    ----------
    sequence
        Frames in order of time.
    frames
        Increasing indices.
    progress
        Called with the stage, frames done and frames in all.
    front_end
        Measures them; :class:`~conformodal.motion.MotionFrontEnd` by default.
    landmarks
        Whether submaps are built and images described, so that landmarks can be recognised in them.
    """
    answer = set(frames.tolist())
    front_end = front_end or MotionFrontEnd(sequence.camera)
    found = MotionRecord({}, {})
    recording = None
    corners: dict[int, Corners] = {}
    span = range(int(frames.min()), int(frames.max()) + 1) if frames.size else range(0)
    for done, i in enumerate(span, start=1):
        if sequence.recording[i] != recording:
            _add_submaps(found, corners, sequence)
            corners = {}
            front_end.reset()
            recording = sequence.recording[i]
        try:
            image = sequence.image(i)
        except ImageError as exc:
            if i in answer:
                found.unreadable[i] = str(exc)
            continue
        if i in answer:
            found.motions[i] = front_end.measure(image)
            if landmarks:
                corners[i] = front_end.corners
                found.described[i] = describe(image, sequence.camera)
        else:
            front_end.pass_by(image)
        if progress is not None:
            progress("motion", done, len(span))
    _add_submaps(found, corners, sequence)
    return found


def _add_submaps(found: MotionRecord, corners: dict[int, Corners], sequence: Sequence) -> None:
    frames = dict(enumerate(corners))
    submaps = (submap.renumbered(frames) for submap in build_submaps(list(corners.values()), sequence.camera))
    found.submaps.extend(submap for submap in submaps if submap is not None)
