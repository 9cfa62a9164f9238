"""Where one camera sees the pixels of another."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, Float32Array, FloatArray

from .camera import PinholeCamera

_SHRINK = 1.5  # images finer than so many times are made coarser first
_FAR = 1e6  # pixels: beyond any image, also a smaller one
_OUTSIDE = 1.05  # of the widest ray of a lens: beyond, it may fold into the image again


def on_plane(camera: PinholeCamera, pixels: FloatArray) -> FloatArray:
    """Where rays through pixels (n, 2) as they are on the image meet the plane at depth 1."""
    return camera.on_plane(camera.undistort(pixels))


@lru_cache(maxsize=16)
def view_maps(source: PinholeCamera, target: PinholeCamera) -> tuple[Float32Array, Float32Array]:
    """Where in an image of a source the pixels of the target are, x and y; far outside where it does not see them."""
    grid = np.indices((target.height, target.width))[::-1].reshape(2, -1).T.astype(np.float64)
    plane, lens = on_plane(target, grid), np.array(source.distortion)
    rays = np.column_stack((plane, np.ones(len(plane))))
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), source.matrix, lens)[0][:, 0]
    corners = np.array([[x, y] for x in (0.0, source.width - 1) for y in (0.0, source.height - 1)])
    widest = float(np.linalg.norm(on_plane(source, corners), axis=1).max())
    visible = (np.linalg.norm(plane, axis=1) <= _OUTSIDE * widest) & np.isfinite(pixels).all(axis=1)
    pixels[~visible] = -_FAR
    x, y = np.clip(pixels, -_FAR, _FAR).T.reshape(2, target.height, target.width).astype(np.float32)
    return x, y


def filled_share(source: PinholeCamera, target: PinholeCamera) -> float:
    """How much of the target's image a source sees."""
    x, y = view_maps(source, target)
    return float(np.mean((x >= 0) & (x <= source.width - 1) & (y >= 0) & (y <= source.height - 1)))


def view_as(pixels: AnyArray, camera: PinholeCamera, target: PinholeCamera) -> AnyArray:
    """An image as another camera would have seen it; unchanged if it is not of its own camera's size."""
    if camera == target or pixels.shape[:2] != (camera.height, camera.width):
        return pixels
    x, y = view_maps(camera, target)
    finer = camera.fx / target.fx
    if finer > _SHRINK:  # what a pixel covers is averaged, not one point of it taken
        pixels = cv2.resize(pixels, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)
        scale = pixels.shape[1] / camera.width, pixels.shape[0] / camera.height
        x, y = (x + 0.5) * scale[0] - 0.5, (y + 0.5) * scale[1] - 0.5
    return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
