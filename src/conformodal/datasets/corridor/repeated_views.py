"""The truth about ambiguity: the other poses from which a building looks the same."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .render import CAMERA_NOISE_LEVELS, Renderer

# Two views are the same if all but this share of the pixels agree within three spreads of the camera's noise.
MAX_SHARE_DIFFERENT = 0.001
MAX_LEVEL_DIFFERENCE = 3 * CAMERA_NOISE_LEVELS


def same_views(renderer: Renderer, T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Other poses from which the view is the same, (m, 4, 4); the pose itself is not among them.

    Without what is unique in it the building repeats itself, so the only candidates are its repetitions; each is
    rendered without noise and compared pixel by pixel.
    """
    own = renderer.render(T_world_cam).astype(np.int16)
    found = []
    for pose in renderer.world.repetitions(T_world_cam):
        different = (np.abs(renderer.render(pose).astype(np.int16) - own) > MAX_LEVEL_DIFFERENCE).any(axis=2)
        if different.mean() <= MAX_SHARE_DIFFERENT:
            found.append(pose)
    return np.array(found).reshape(-1, 4, 4)
