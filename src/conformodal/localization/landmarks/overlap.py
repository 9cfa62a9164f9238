"""How much of what one camera sees others see too."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.poses import PinholeCamera


def view_overlap(poses_se3: FloatArray, i: int, camera: PinholeCamera, depth_m: float) -> FloatArray:
    """Shares (n,) of what frame `i` sees that other frames see too, from their poses (n, 4, 4) ``T_world_cam``.

    Points on a grid of pixels, at half, once and twice the depth, stand for what it sees; walls are not known.
    """
    # middles of cells: on the image's very edges rounding would decide, and no frame would see all that it sees
    across, down = ((np.arange(count) + 0.5) * side / count for side, count in ((camera.width, 5), (camera.height, 4)))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = np.column_stack((camera.on_plane(pixels), np.ones(len(pixels))))
    points = np.concatenate([rays * (depth_m * times) for times in (0.5, 1.0, 2.0)])
    world = points @ poses_se3[i, :3, :3].T + poses_se3[i, :3, 3]
    local = (world - poses_se3[:, None, :3, 3]) @ poses_se3[:, :3, :3]
    ahead = local[..., 2] > 1e-6
    plane = local[..., :2] / np.where(ahead, local[..., 2], 1.0)[..., None]
    seen = plane * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ahead & (seen >= 0).all(axis=2) & (seen < (camera.width, camera.height)).all(axis=2)
    return np.asarray(inside.mean(axis=1))
