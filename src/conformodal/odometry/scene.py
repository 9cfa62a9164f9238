"""What training frames say about the scene without a network: how deep it is, and where its landmarks are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from conformodal.datasets import Sequence, Split, held_out_together
from conformodal.motion import describe
from conformodal.poses import PoseFix

from .depths import measure_depths
from .landmarks import Landmarks, fit_landmarks
from .motions import Progress


@dataclass(frozen=True, eq=False)
class Scene:
    """The scene of a model.

    Attributes
    ----------
    depth_m, depth_spread
        Median depth of corners, and the spread of its logarithm; NaN where they are not known.
    landmarks
        None where too few corners can be placed.
    calibration_fixes
        Of every calibration frame by landmarks of the training part; None without landmarks.
    """

    depth_m: float = math.nan
    depth_spread: float = math.nan
    landmarks: Landmarks | None = None
    calibration_fixes: list[list[PoseFix]] | None = None


def learn_scene(sequence: Sequence, split: Split, *, landmarks: bool = True, progress: Progress | None = None) -> Scene:
    """Look at the training and the calibration frames; what they say is kept apart, see :class:`Fixes`.

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
    described = []
    for i in frames.tolist():
        described.append(describe(sequence.image(i), sequence.camera))
        if progress is not None:
            progress("corners", len(described), len(frames))
    pieces = held_out_together(sequence.recording, split.kind)[frames]
    stage = None if progress is None else lambda done, total: progress("landmarks", done, total)
    reserved = np.isin(frames, split.calibration)
    known = fit_landmarks(described, truth[frames], pieces, sequence.camera, depth, stage, reserved)
    if known is None:
        return Scene(depth, spread)
    held_out = [described[k] for k in np.searchsorted(frames, split.calibration)]
    return Scene(depth, spread, known, [known.region_fixes(image) for image in held_out])
