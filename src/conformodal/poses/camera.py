"""A pinhole camera without distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import PoseError


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels, for images of `width` x `height`; (cx, cy) is the principal point.

    Raises
    ------
    PoseError
        If a focal length or a size is not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (min(self.fx, self.fy) > 0 and min(self.width, self.height) > 0 and np.isfinite(self.cx + self.cy)):
            raise PoseError(f"camera needs positive focal lengths and sizes, got {self}")

    def bearings(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Unit rays (n, 3) in the camera frame (x right, y down, z forward) through pixels (n, 2)."""
        xy = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        rays = np.column_stack((xy, np.ones(len(xy))))
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
