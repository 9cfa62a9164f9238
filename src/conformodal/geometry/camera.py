"""A pinhole camera, the distortion of its lens, and its shutter, which reads rows one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.ranges import Range
from conformodal.core.schema import ListOf

from .poses import PoseError

NO_FLOW = np.zeros((2, 3))
_FOCAL, _CENTRE, _SIDE = Range(0, 1e6, "(]"), Range(-1e6, 1e6), Range(1, 100_000, whole=True)
# a camera in a saved model, see conformodal.core.schema.check_json
CAMERA_JSON = {
    "fx": _FOCAL,
    "fy": _FOCAL,
    "cx": _CENTRE,
    "cy": _CENTRE,
    "width": _SIDE,
    "height": _SIDE,
    "distortion": ListOf(Range(-1e3, 1e3), least=0),
}


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels, for images of `width` x `height`; (cx, cy) is the principal point."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    # radial and tangential, (k1, k2, p1, p2) or (k1, k2, p1, p2, k3) as in OpenCV and EuRoC; empty for a lens without
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

    def poselib(self) -> dict[str, object]:
        """The intrinsics as PoseLib takes them; corners are undistorted before."""
        params = [self.fx, self.fy, self.cx, self.cy]
        return {"model": "PINHOLE", "width": self.width, "height": self.height, "params": params}

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Pixels (n, 2) of the same rays in the pinhole camera without distortion."""
        if not self.distortion or not len(pixels):
            return pixels
        import cv2  # noqa: PLC0415 - poses and regions need no package for images

        # in OpenCV 4 the function that takes a criterion has its own name; in OpenCV 5 there is one function
        undistort_points = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-8)
        lens = np.array(self.distortion)
        ideal = undistort_points(pixels[:, None], self.matrix, lens, R=np.eye(3), P=self.matrix, criteria=until)
        return np.asarray(ideal, dtype=np.float64)[:, 0]

    def distort(self, pixels: FloatArray) -> FloatArray:
        """Where undistorted pixels (n, 2) are in the image: the inverse of :meth:`undistort`."""
        if not self.distortion or not len(pixels):
            return pixels
        import cv2  # noqa: PLC0415 - poses and regions need no package for images

        rays = np.column_stack((self.on_plane(pixels), np.ones(len(pixels))))
        image, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
        return np.asarray(image, dtype=np.float64)[:, 0]

    def compensate_rolling_shutter(self, pixels: FloatArray, flow: FloatArray, shutter: FloatArray) -> FloatArray:
        """Where undistorted pixels (..., 2) are when the given pose is taken, from their flow (..., 2).

        `shutter` are the seconds by which the middle row is late, and those between the first row and the last.
        """
        late = shutter[0] + shutter[1] * (pixels[..., 1:] / self.height - 0.5)
        return np.asarray(pixels - late * flow)
