"""What training frames say about the scene without a network: how deep it is, and where its landmarks are."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from conformodal.datasets import Sequence, Split, SplitKind, held_out_together
from conformodal.motion import Described, Matcher, describe
from conformodal.poses import PoseFix

from .depths import measure_depths
from .landmarks import Landmarks, fit_landmarks
from .motions import Progress

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scene:
    """The scene of a model.

    Attributes
    ----------
    depth_m, depth_spread
        Median depth of corners, and the spread of its logarithm; NaN where they are not known.
    landmarks
        Of training and calibration frames; None where too few corners can be placed.
    region_landmarks
        Of the training frames alone.
    calibration_fixes
        Of every calibration frame, by these; empty without them.
    """

    depth_m: float = math.nan
    depth_spread: float = math.nan
    landmarks: Landmarks | None = None
    region_landmarks: Landmarks | None = None
    calibration_fixes: list[list[PoseFix]] = field(default_factory=list)


def learn_scene(sequence: Sequence, split: Split, *, landmarks: bool = True, progress: Progress | None = None) -> Scene:
    """Look at the training and the calibration frames.

    Two maps are made of them: one of all, for the search, and one that knows nothing of the calibration frames.

    Parameters
    ----------
    sequence
        With poses.
    split
        Of its frames.
    landmarks
        Whether to look for landmarks.
    progress
        Called with the stage, frames done and frames in all.

    Raises
    ------
    PoseError
        If the sequence has no poses.
    ImageError
        If an image cannot be read; names the file.
    """
    truth = sequence.require_truth()
    depth, spread = measure_depths(sequence, split.train)
    frames = np.sort(np.concatenate((split.train, split.calibration)))
    if not (landmarks and np.isfinite(depth)):
        return Scene(depth, spread)
    described: dict[int, Described] = {}
    for i in frames.tolist():
        described[i] = describe(sequence.image(i), sequence.camera)
        if progress is not None:
            progress("corners", len(described), len(frames))
    pieces = held_out_together(sequence.recording, split.kind, given_test=sequence.given_test)
    matcher = Matcher()

    def fit(known: IntArray, stage: str) -> Landmarks | None:
        report = None if progress is None else lambda done, total: progress(stage, done, total)
        images, left_out = [described[i] for i in known.tolist()], pieces[known]
        if len(np.unique(left_out)) < 2:  # one recording: without all of it nothing is left to learn spreads from
            left_out = held_out_together(sequence.recording, SplitKind.BLOCKS)[known]
        return fit_landmarks(images, truth[known], left_out, sequence.camera, depth, report, matcher)

    regions = fit(split.train, "landmarks of the training part")
    fixes = [] if regions is None else [regions.fixes(described[i]) for i in split.calibration.tolist()]
    return Scene(depth, spread, fit(frames, "landmarks"), regions, fixes)
