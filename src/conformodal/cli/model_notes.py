"""Notes on a trained model, printed after training: its landmarks, its split, the coverage its regions guarantee."""

from __future__ import annotations

from math import ceil

import numpy as np

from conformodal.conformal.checks import as_alpha
from conformodal.core.arrays import IntArray
from conformodal.core.words import counted, noun_for
from conformodal.geometry import PinholeCamera
from conformodal.io import Split, frames_to_known
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.targets import TARGET_NAMES
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.model import PoseModel

_NEAR_FRAMES = 5
_FOCAL_OFF = 0.02  # a focal length that differs by a larger share is reported


def describe_landmarks(landmarks: LandmarkSource | None, camera: PinholeCamera) -> str:
    """How many landmarks there are, and the focal length that the poses imply if it is another."""
    if landmarks is None:
        return "no landmarks: too few corners of the training frames could be triangulated; other sources answer"
    n_landmarks, n_frames = (int(landmarks.summary[name]) for name in ("n_landmarks", "n_keyframes"))
    text = f"{counted(n_landmarks, 'landmark')} of {counted(n_frames, 'frame')}"
    implied, given = landmarks.map.camera.fx, camera.fx
    if abs(implied / given - 1) > _FOCAL_OFF:
        text += f"; the poses imply a focal length of {implied:.0f} px where {given:.0f} px is given: check the camera"
    return text


def distances(split: Split, recording: IntArray) -> dict[str, float | None]:
    """Median frames from a test frame to the nearest known one, and the share within five; null if none is known."""
    frames = frames_to_known(split, recording)
    median = float(np.median(frames))
    return {
        "median_frames_to_known": median if np.isfinite(median) else None,
        "share_within_5_frames": float(np.mean(frames <= _NEAR_FRAMES)),
    }


def describe_distances(distance: dict[str, float | None]) -> str:
    """How near the test frames are to frames that are known, see :func:`distances`."""
    median, near = distance["median_frames_to_known"], distance["share_within_5_frames"] or 0
    if median is None:
        return "test frames are from recordings without a training or calibration frame"
    return (
        f"test frames lie a median of {median:g} {noun_for(int(median), 'frame')} from the nearest training or "
        f"calibration frame, {100 * near:.0f} % of them within {_NEAR_FRAMES}"
    )


def describe_calibration(model: PoseModel, config: ModelConfig, n_recordings: int) -> list[str]:
    """Notes on the calibration; `n_recordings` counts those of training and calibration frames."""
    rule, n = model.calibration, model.calibration.n_units
    unit, units = ("recording", "recordings") if n == n_recordings else ("stretch", "stretches")
    if rule.units_ is None:
        unit, units = "frame", "frames"
        lines = [f"regions are calibrated on the {counted(n, 'frame')} of the calibration part"]
    else:
        lines = [
            f"regions are calibrated on {counted(n, unit, units)}, {counted(model.n_calibration, 'frame')} of the "
            f"training and calibration parts; each frame is answered by sources that did not see its {unit}"
        ]
    if rule.joint != config.joint:
        needed = ceil(len(TARGET_NAMES) / as_alpha(model.alpha)) - 1
        lines.append(
            f"the whole pose has one threshold (joint {rule.joint}): one for each target (joint {config.joint}) needs "
            f"{needed} {units} of each evidence type at alpha {model.alpha:g}"
        )
    if config.method is Method.PAPER:
        lines.append("images are not tested for unknown places: the paper has no such test")
    elif model.novelty is None:
        lines.append("images are not tested for unknown places: the data are one piece, and the test leaves one out")
    elif model.rules.level < (least := model.novelty.test.least_p):
        lines.append(f"no image is taken for an unknown place: no p-value of these data is below {least:.3g}")
    else:
        lines.append(
            f"an image is taken for an unknown place where its p-value is at most {model.rules.level:.3g}, or "
            f"{model.recognised_level:.3g} if a place is recognised"
        )
    return lines
