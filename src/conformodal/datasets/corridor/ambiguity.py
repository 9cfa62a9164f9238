"""The truth about ambiguity: the other poses from which the corridor looks the same."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .render import CAMERA_NOISE_LEVELS, Renderer
from .world import MODULE_LENGTH

# Two views are the same if all but this share of the pixels agree within three spreads of the camera's noise.
MAX_SHARE_DIFFERENT = 0.001
MAX_LEVEL_DIFFERENCE = 3 * CAMERA_NOISE_LEVELS


def same_views(renderer: Renderer, T_world_cam: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Other poses from which the view is the same, (m, 4, 4); the pose itself is not among them.

    Without its landmarks and ends the hall repeats itself every module, so the only candidates are the pose moved
    by whole modules; each is rendered without noise and compared pixel by pixel.
    """
    own = renderer.render(T_world_cam).astype(np.int16)
    found = []
    place = int(T_world_cam[0, 3] // MODULE_LENGTH)
    for k in range(-place, renderer.world.n_modules - place):
        if k == 0:
            continue
        moved = T_world_cam.copy()
        moved[0, 3] += k * MODULE_LENGTH
        other = renderer.render(moved).astype(np.int16)
        different = (np.abs(other - own) > MAX_LEVEL_DIFFERENCE).any(axis=2)
        if different.mean() <= MAX_SHARE_DIFFERENT:
            found.append(moved)
    return np.array(found).reshape(-1, 4, 4)
