"""Fisheye lenses, and where one camera sees the pixels of another.

A fisheye lens (Kannala and Brandt 2006, as OpenCV has it) sends a ray at the angle t from the axis to the radius
t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), in units of the focal length.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import atan, degrees, hypot
from typing import TypeAlias

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, Float32Array, FloatArray

from .camera import PinholeCamera

_STEPS = 4096
_SHRINK = 1.5  # images finer than so many times are made coarser first
_OUTSIDE = 1.05  # of the widest ray of a lens: beyond, it may fold into the image again


@dataclass(frozen=True)
class Fisheye:
    """A fisheye lens, and the pinhole camera that its images are undistorted to."""

    pinhole: PinholeCamera  # of the same size, focal lengths and principal point
    coefficients: tuple[float, float, float, float]  # k1, k2, k3, k4

    def radius(self, angle_rad: FloatArray) -> FloatArray:
        """Where rays (n,) at an angle from the axis fall, in focal lengths from the principal point."""
        even = np.polynomial.polynomial.polyval(angle_rad**2, (1.0, *self.coefficients))
        return np.asarray(angle_rad * even)

    @property
    def corner_rad(self) -> float:
        """Angle from the axis at the farthest corner of the pinhole camera's image."""
        pinhole = self.pinhole
        x, y = max(pinhole.cx, pinhole.width - pinhole.cx), max(pinhole.cy, pinhole.height - pinhole.cy)
        return atan(hypot(x / pinhole.fx, y / pinhole.fy))

    def fold_rad(self, widest_rad: float) -> float:
        """Angle from the axis at which the image folds over itself, infinite if not up to `widest_rad`."""
        angles = np.linspace(0, widest_rad, _STEPS)
        folds = np.flatnonzero(~(np.diff(self.radius(angles)) > 0))
        return float(angles[folds[0]]) if folds.size else np.inf

    def views_deg(self) -> tuple[float, float]:
        """What the lens sees across its image's width, and what the pinhole camera keeps of it."""
        angles = np.linspace(0, min(np.pi, self.fold_rad(np.pi)), _STEPS)
        sides = np.array([self.pinhole.cx, self.pinhole.width - self.pinhole.cx]) / self.pinhole.fx
        lens = np.interp(sides, self.radius(angles), angles).sum()
        return degrees(float(lens)), degrees(float(np.arctan(sides).sum()))


AnyCamera: TypeAlias = PinholeCamera | Fisheye


def pinhole_of(camera: AnyCamera) -> PinholeCamera:
    """The camera itself, or that which a fisheye lens is undistorted to."""
    return camera.pinhole if isinstance(camera, Fisheye) else camera


def on_plane(camera: PinholeCamera, pixels: FloatArray) -> FloatArray:
    """Where rays through pixels (n, 2) as they are on the image meet the plane at depth 1."""
    return camera.on_plane(camera.undistort(pixels))


@lru_cache(maxsize=16)
def view_maps(source: AnyCamera, target: PinholeCamera) -> tuple[Float32Array, Float32Array]:
    """Where in an image of a source the pixels of the target are, x and y; -1 where the source does not see them."""
    grid = np.indices((target.height, target.width))[::-1].reshape(2, -1).T.astype(np.float64)
    plane, pinhole = on_plane(target, grid), pinhole_of(source)
    if isinstance(source, Fisheye):
        pixels = cv2.fisheye.distortPoints(plane[:, None], pinhole.matrix, np.array(source.coefficients)).reshape(-1, 2)
        fold = source.fold_rad(np.pi / 2)
        widest = np.tan(fold) if fold < np.pi / 2 else np.inf
    else:
        rays, lens = np.column_stack((plane, np.ones(len(plane)))), np.array(source.distortion)
        pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), source.matrix, lens)[0][:, 0]
        corners = np.array([[x, y] for x in (0.0, source.width - 1) for y in (0.0, source.height - 1)])
        widest = float(np.linalg.norm(on_plane(source, corners), axis=1).max())
    visible = (np.linalg.norm(plane, axis=1) <= _OUTSIDE * widest) & np.isfinite(pixels).all(axis=1)
    pixels[~visible] = -1
    x, y = np.clip(pixels, -1e6, 1e6).T.reshape(2, target.height, target.width).astype(np.float32)
    return x, y


def filled_share(source: AnyCamera, target: PinholeCamera) -> float:
    """How much of the target's image a source sees."""
    x, y = view_maps(source, target)
    pinhole = pinhole_of(source)
    return float(np.mean((x >= 0) & (x <= pinhole.width - 1) & (y >= 0) & (y <= pinhole.height - 1)))


def view_as(pixels: AnyArray, camera: AnyCamera, target: PinholeCamera) -> AnyArray:
    """An image as another camera would have seen it; unchanged if it is not of its own camera's size."""
    pinhole = pinhole_of(camera)
    if camera == target or pixels.shape[:2] != (pinhole.height, pinhole.width):
        return pixels
    x, y = view_maps(camera, target)
    finer = pinhole.fx / target.fx
    if finer > _SHRINK:  # what a pixel covers is averaged, not one point of it taken
        pixels = cv2.resize(pixels, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)
        scale = pixels.shape[1] / pinhole.width, pixels.shape[0] / pinhole.height
        x, y = (x + 0.5) * scale[0] - 0.5, (y + 0.5) * scale[1] - 0.5
    return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
