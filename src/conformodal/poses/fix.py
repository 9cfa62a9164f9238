"""A pose fix: where an image says the camera is, from things it knows the places of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseFix:
    """A pose of one frame, with the spreads of its errors.

    Attributes
    ----------
    position_xyz, orientation_quat_wxyz
        (3,) metres and (4,): the frame's pose, camera to world.
    sigma_m, sigma_rad
        Spreads of their errors, per axis and about each axis.
    n_inliers
        Different observations that agree with it: a corner counts once.
    trust
        Probability that it is not altogether wrong; of several of one image, each as if the others were wrong.
    inlier_share
        Share of the matched observations that agree with it.
    image_share
        Share of the image over which they are spread.
    apart
        How far the nearest frame with a known pose is, in units of the scene's depth and radians; 0 where not known.
    """

    position_xyz: FloatArray
    orientation_quat_wxyz: FloatArray
    sigma_m: float
    sigma_rad: float
    n_inliers: int
    trust: float = 1.0
    inlier_share: float = 1.0
    image_share: float = 1.0
    apart: float = 0.0
