"""Where corners are when the pose of a frame is taken: rows of a rolling shutter are read one after the other."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import FloatArray

from .camera import PinholeCamera

NO_FLOW = np.zeros((2, 3))


def at_pose_time(pixels: FloatArray, flow: FloatArray, shutter: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Where undistorted pixels (..., 2) are when the given pose is taken, from their flow (..., 2).

    `shutter` are the seconds by which the middle row is late, and those between the first row and the last.
    """
    late = shutter[0] + shutter[1] * (pixels[..., 1:] / camera.height - 0.5)
    return np.asarray(pixels - late * flow)
