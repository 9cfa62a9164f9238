"""Notes on a trained model, printed after training: its landmarks, its split, the coverage its regions guarantee."""

from __future__ import annotations

from math import ceil

import numpy as np

from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core.arrays import IntArray
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera
from conformodal.io import Split, frames_to_known
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.targets import TARGET_NAMES
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.model import PoseModel
from conformodal.quality.advice import WHERE
from conformodal.quality.guarantee import guarantees

_NEAR_FRAMES = 5
_FOCAL_OFF = 0.02  # a focal length that differs by a larger share is reported


def describe_landmarks(landmarks: LandmarkSource | None, camera: PinholeCamera) -> str:
    """Note on the landmarks."""
    if landmarks is None:
        return (
            "no landmarks: too few corners of the training frames could be triangulated; the belief rests on the other "
            "sources"
        )
    n_landmarks, n_frames = (int(landmarks.summary[name]) for name in ("n_landmarks", "n_keyframes"))
    text = f"{counted(n_landmarks, 'landmark')} of {counted(n_frames, 'frame')}"
    found, given = landmarks.map.camera.fx, camera.fx
    if abs(found / given - 1) > _FOCAL_OFF:
        text += (
            f"; the poses imply a focal length of {found:.0f} px where {given:.0f} px is given: landmarks use the "
            "former, all else the latter"
        )
    return text


def distances(split: Split, recording: IntArray) -> dict[str, float | None]:
    """Median frames from a test frame to the nearest known one, and the share within five; null if none is known."""
    found = frames_to_known(split, recording)
    median = float(np.median(found))
    return {
        "median_frames_to_known": median if np.isfinite(median) else None,
        "share_within_5_frames": float(np.mean(found <= _NEAR_FRAMES)),
    }


def describe_distances(split: Split, recording: IntArray) -> str:
    """How near the test frames are to frames that are known, see :func:`distances`."""
    found = distances(split, recording)
    if found["median_frames_to_known"] is None:
        return "test frames are from recordings without a training or calibration frame"
    median = found["median_frames_to_known"]
    return (
        f"test frames lie a median of {median:g} {'frame' if median == 1 else 'frames'} from the nearest training or "
        f"calibration frame, {100 * (found['share_within_5_frames'] or 0):.0f} % of them within {_NEAR_FRAMES}"
    )


def describe_repeated(n_repeated: int, n_test: int) -> list[str]:
    """Warning about test frames with the pixels of a known frame; nothing if there are none."""
    if not n_repeated:
        return []
    shows, their = ("shows", "its") if n_repeated == 1 else ("show", "their")
    return [
        f"{n_repeated} of {counted(n_test, 'test frame')} {shows} the same picture as a training or calibration frame: "
        f"{their} errors and regions do not show what to expect of new images"
    ]


def describe_calibration(model: PoseModel, config: ModelConfig, n_recordings: int) -> list[str]:
    """Notes on the calibration; `n_recordings` counts those of training and calibration frames."""
    softmax, n_frames = model.calibration, model.n_calibration
    by_frame, n = softmax.groups_ is None, softmax.n_units
    unit, units = ("recording", "recordings") if n == n_recordings else ("stretch", "stretches")
    if by_frame:
        lines = [f"regions are calibrated on the {counted(n, 'frame')} of the calibration part"]
    else:
        lines = [
            f"regions are calibrated on {counted(n, unit, units)}, {counted(n_frames, 'frame')} of the "
            f"training and calibration parts together; each frame is answered by sources that did not see its {unit}"
        ]
    if softmax.joint != config.joint:
        least = min((one for one in guarantees(model) if one.weight >= one.weight_needed), key=lambda one: one.weight)
        lines.append(
            f"the whole pose has one threshold (joint {softmax.joint}), not one for each target (joint "
            f"{config.joint}): at alpha {model.alpha:g}, alpha / {len(TARGET_NAMES)} needs "
            f"{_units_needed(model.alpha)} {'frames' if by_frame else units} of each evidence type, and those "
            f"{WHERE[least.evidence]} weigh {least.weight:.4g}"
        )
    if config.method is Method.PAPER:
        lines.append("images are not tested for unknown places: the paper has no such test")
    elif model.novelty is None:
        lines.append(
            "images are not tested for unknown places: the test leaves out one piece of the data at a time, and there "
            "is only one piece"
        )
    elif model.rules.level < model.novelty.test.least_p:
        lines.append(
            f"no image is taken for an unknown place at the novelty level {model.rules.level:g}: with "
            f"{counted(model.novelty.test.n_groups, 'piece')} of the data no p-value is below "
            f"{model.novelty.test.least_p:.3g}"
        )
    else:
        lines.append(
            f"an image is taken for an unknown place where its p-value is at most {model.rules.level:.3g}, or "
            f"{model.recognised_level:.3g} if a place is recognised"
        )
    return lines


def _units_needed(alpha: Alpha) -> int:
    """Frames or stretches that a finite threshold for each target at its share of alpha needs."""
    return ceil(len(TARGET_NAMES) / as_alpha(alpha)) - 1
