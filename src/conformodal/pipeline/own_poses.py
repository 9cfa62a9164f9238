"""Recordings without poses that extend a model: its own answers take the place of poses, where it is sure of them.

Scores against such poses would be too small, and only frames of which the model is sure have one. So they teach where
things are, and neither calibrate nor teach how large errors are.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, noun_for
from conformodal.io import Recording

from .config import OdometryError
from .estimator import VisualOdometry
from .model import ONLINE, JournalEntry, PoseModel

_MIN_RELIABLE = 10  # frames: fewer show hardly more than one view


class ReliableFrames(NamedTuple):
    """The frames of a recording of which a model is sure, with the poses that it gives them."""

    recording: Recording
    frames: IntArray  # (m,) which of the whole recording's they are
    entry: JournalEntry  # how the whole recording was answered


def answer_reliably(model: PoseModel, recording: Recording, progress: StageProgress | None = None) -> ReliableFrames:
    """Answer a recording as a stream that ends; its reliable frames get the poses of the smoothed path.

    Raises
    ------
    OdometryError
        If fewer than ten frames are reliable.
    """
    run, name, n = VisualOdometry(model).process(recording, progress=progress), recording.name, len(recording)
    rows = np.flatnonzero(run.reliable)
    frames = run.frames[rows]
    if len(frames) < _MIN_RELIABLE:
        raise OdometryError(
            f"{name}: has no poses, and {len(frames)} of {counted(n, 'frame')} ({100 * len(frames) / n:.0f} %) "
            f"{noun_for(len(frames), 'is', 'are')} reliable, expected {_MIN_RELIABLE} or more; begin where the model "
            "knows the place, move more slowly, or give poses"
        )
    paths = run.path_regions.get(ONLINE)
    entry = JournalEntry(
        name=name,
        date=datetime.now(UTC).date().isoformat(),
        n_frames=n,
        coverage=None,
        bounded=float((~run.regions.unbounded.any(axis=1)).mean()),
        path_coverage=None,
        path_bounded=None if paths is None else float((~paths.unbounded.any(axis=1)).mean()),
        reliable=len(frames) / n,
        median_m=None,
        first_unit=0,
        n_units=0,
    )
    joining = replace(
        recording,
        image_paths=tuple(recording.image_paths[i] for i in frames.tolist()),
        timestamps_s=recording.timestamps_s[frames],
        recording=recording.recording[frames],
        poses=run.trajectory[rows],
        given_test=None,
    )
    return ReliableFrames(joining, frames, entry)
