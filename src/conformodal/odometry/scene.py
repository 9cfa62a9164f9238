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
from .errors import OdometryError
from .folds import Folds, make_folds
from .landmarks import N_LEFT_OUT, Landmarks, fit_landmarks
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
        Of the frames that the region's sources learn from.
    calibration_fixes
        Of every frame that calibrates, by a map that does not know it; empty without landmarks.
    calibration_frames
        (n,) those frames, fold by fold.
    """

    depth_m: float = math.nan
    depth_spread: float = math.nan
    landmarks: Landmarks | None = None
    region_landmarks: Landmarks | None = None
    calibration_fixes: list[list[PoseFix]] = field(default_factory=list)
    calibration_frames: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def check_folds(self, folds: Folds) -> None:
        """Refuse folds that hold out other frames than those that the fixes are of.

        Raises
        ------
        OdometryError
            If they do.
        """
        own, others = self.calibration_frames, folds.held_out
        if self.region_landmarks is not None and not np.array_equal(own, others):
            raise OdometryError(
                f"the scene was learnt with other folds: it has fixes of {len(own)} frames, and {len(others)} frames, "
                "not the same or in another order, calibrate"
            )


def learn_scene(
    sequence: Sequence,
    split: Split,
    folds: Folds | None = None,
    *,
    landmarks: bool = True,
    progress: Progress | None = None,
) -> Scene:
    """Look at the training and the calibration frames.

    One map is made of all of them, for the search, and one for each fold, which knows nothing of the frames that it
    answers.

    Parameters
    ----------
    sequence
        With poses.
    split
        Of its frames.
    folds
        From :func:`~conformodal.odometry.make_folds`; by default those of the split.
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
    folds = folds or make_folds(sequence, split)
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
    stretches = held_out_together(sequence.recording, SplitKind.BLOCKS)
    matcher = Matcher()

    def fit(known: IntArray, stage: str, n_left_out: int = N_LEFT_OUT) -> Landmarks | None:
        report = None if progress is None else lambda done, total: progress(stage, done, total)
        left_out = stretches if len(np.unique(pieces[known])) < 2 else pieces
        groups = left_out[known], stretches[known]
        images = [described[i] for i in known.tolist()]
        return fit_landmarks(images, truth[known], groups, sequence.camera, depth, report, matcher, n_left_out)

    everything, fixes, own = fit(frames, "landmarks"), [], None
    for k, fold in enumerate(folds.folds):
        alone = len(folds.folds) == 1
        own = fit(fold.train, f"landmarks, part {k + 1}", N_LEFT_OUT if alone else N_LEFT_OUT // 4)
        fixes += [[] if own is None else own.fixes(described[i]) for i in fold.held_out.tolist()]
    regions = everything if len(folds.region_frames) == len(frames) else own
    return Scene(depth, spread, everything, regions, fixes if regions is not None else [], folds.held_out)
