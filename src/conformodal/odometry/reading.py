"""The frames of a sequence that are to be estimated: which of them can be read, and their features."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.core import IntArray, StageProgress, stage_of
from conformodal.datasets import Sequence
from conformodal.vision import FeatureCache, extract_features

from .errors import OdometryError
from .frame import as_frames
from .model import PoseModel
from .motions import MotionRecord


def chosen_frames(model: PoseModel, sequence: Sequence, frames: IntArray | None) -> IntArray:
    """Indices of the frames to answer; all by default.

    Raises
    ------
    OdometryError
        If the camera is another one, or `frames` are not increasing indices of frames.
    """
    model.check_camera(sequence.camera)
    return np.arange(len(sequence)) if frames is None else as_frames(frames, len(sequence))


def read_frames(
    model: PoseModel,
    sequence: Sequence,
    frames: IntArray | None,
    motions: MotionRecord,
    cache: FeatureCache | None,
    progress: StageProgress | None,
) -> tuple[IntArray, npt.NDArray[np.float32]]:
    """Indices (m,) of the frames that can be read, and their features (m, F).

    Raises
    ------
    OdometryError
        As :func:`chosen_frames`, or if no frame can be read.
    """
    wanted = chosen_frames(model, sequence, frames)
    usable = np.array([i for i in wanted.tolist() if i in motions.motions], dtype=np.int64)
    if usable.size == 0:
        raise OdometryError(f"{sequence.name}: none of {wanted.size} frames can be read: {motions.unreadable}")
    features = extract_features(
        [sequence.image_paths[i] for i in usable],
        model.backbone,
        cache or FeatureCache(None),
        stage_of(progress, "network"),
        sequence.noise,
    )
    return usable, features
