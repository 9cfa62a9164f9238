"""The frame and the target that the paper's figures 1, 2a and 2b show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.core import FloatArray
from conformodal.datasets import Sequence
from conformodal.experiments.table1 import Softmaxes
from conformodal.localization import pose_targets
from conformodal.motion import CornerTracker, grey_image
from conformodal.report.overview import SoftmaxOfTarget, Steps
from conformodal.report.stored import StoredRun

MOST_CUBOIDS = 30  # that an eye can tell apart
_FLOW_OVER = 5  # frames
_POSITION = "xyz"


def steps_of(said: Softmaxes, run: StoredRun, sequence: Sequence) -> Steps:
    """One frame of a run, and the target that has most intervals there.

    Of the frames whose region holds the position it is the one with most intervals in a target; if the region holds
    none, or is too many cuboids to see, the one with fewest cuboids.
    """
    targets = pose_targets(run.truth, said.model.sign_reference)
    counts = said.regions.n_intervals[:, :3]
    cuboids = counts.prod(axis=1)
    earlier = np.maximum(said.frames - _FLOW_OVER, 0)
    moved = (earlier < said.frames) & (sequence.recording[earlier] == sequence.recording[said.frames])
    fits = said.regions.contains(targets)[:, :3].all(axis=1) & (cuboids <= MOST_CUBOIDS) & moved
    frame = int(np.argmax(np.where(fits, counts.max(axis=1), -cuboids)))
    shown = int(np.argmax(counts[frame]))
    intervals, edges = said.regions.intervals(frame), said.model.bins.edges_
    softmaxes = [
        SoftmaxOfTarget(
            name, edges[j], said.proba[j][frame], float(said.least[j]), intervals[j], float(targets[frame, j])
        )
        for j, name in enumerate(_POSITION)
    ]
    image, before, now = flow_to(sequence, int(said.frames[frame]))
    positions = run.answer.positions_xyz, run.truth.positions_xyz
    return Steps(image, softmaxes, shown, (before, now), *positions, frame)


def training_values(said: Softmaxes, sequence: Sequence, target: int) -> tuple[FloatArray, FloatArray]:
    """Times (n,), seconds since the first, and a position's component (n,) of the training frames."""
    train = said.model.split.train
    times = sequence.timestamps_s[train]
    return times - times[0], sequence.require_truth().positions_xyz[train, target]


def flow_to(sequence: Sequence, last: int) -> tuple[npt.NDArray[np.uint8], FloatArray, FloatArray]:
    """A frame's image, and corners (m, 2) followed into it: in the frame some frames earlier, and in this one.

    At the beginning of a recording they are followed through the frames that there are.
    """
    same = np.flatnonzero(sequence.recording[: last + 1] == sequence.recording[last])
    start = max(int(same[0]), last - _FLOW_OVER)
    tracker = CornerTracker()
    for i in range(start, last + 1):
        image = sequence.image(i)
        tracker.advance(grey_image(image))
        if i == start:
            tracker.mark()
    return image, *tracker.pairs()
