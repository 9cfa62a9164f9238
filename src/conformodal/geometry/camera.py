"""A pinhole camera, and the distortion of its lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import FloatArray

from .rotations import PoseError


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels, for images of `width` x `height`; (cx, cy) is the principal point.

    Attributes
    ----------
    distortion
        Radial and tangential, (k1, k2, p1, p2) or (k1, k2, p1, p2, k3) in the order of OpenCV and of EuRoC; empty for
        a lens without.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(self.distortion))  # JSON has lists
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            value = getattr(self, name)
            finite = isinstance(value, (int, float, np.number)) and np.isfinite(value)
            anywhere = name in ("cx", "cy")
            if not finite or not (anywhere or value > 0):
                expected = "finite" if anywhere else "positive and finite"
                raise PoseError(f"camera has {name} = {value}, expected {expected} pixels (positive focal lengths)")
        if len(self.distortion) not in (0, 4, 5) or not np.isfinite(self.distortion).all():
            raise PoseError(f"distortion must be k1, k2, p1, p2 and perhaps k3, all finite; got {self.distortion}")

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def on_plane(self, pixels: FloatArray) -> FloatArray:
        """Where rays through undistorted pixels (..., 2) meet the plane at depth 1, (..., 2)."""
        return np.asarray((pixels - (self.cx, self.cy)) / (self.fx, self.fy))

    def bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit rays (n, 3) in the camera frame (x right, y down, z forward) through undistorted pixels (n, 2)."""
        rays = np.column_stack((self.on_plane(pixels), np.ones(len(pixels))))
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
