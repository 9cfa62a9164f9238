"""Which convention given poses have: camera-to-world or its inverse, axes of OpenCV or of OpenGL."""

from __future__ import annotations

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray

from .errors import ImageError
from .lenses import on_plane
from .sequence import Sequence

AS_GIVEN = "camera-to-world, OpenCV axes"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PAIRS, _STEPS, _LEAST_FLOW_PX, _CORNERS, _LEAST_MATCHES = 16, (1, 2, 4, 8), 4.0, 300, 200
_NEAR_PX = 2.0  # from the epipolar line
_BETTER, _EQUAL = 0.2, 0.02  # share of the matches


def fitting_convention(sequence: Sequence) -> tuple[str, dict[str, float]]:
    """The convention under which matched corners lie on the epipolar lines of the poses.

    Parameters
    ----------
    sequence
        With poses for all of its frames.

    Returns
    -------
    best
        Its name; that of the given one where no other is clearly better, or the images do not tell.
    shares
        Share of the matches within 2 pixels of their epipolar line, by convention; empty where there are too few.
    """
    given = sequence.require_truth().poses_se3
    back = np.linalg.inv(given)
    poses = {
        AS_GIVEN: given,
        "world-to-camera, OpenCV axes": back,
        "camera-to-world, OpenGL axes": given @ _OPENGL,
        "world-to-camera, OpenGL axes": back @ _OPENGL,
    }
    near: dict[str, list[FloatArray]] = {name: [] for name in poses}
    for first in np.unique(np.linspace(0, len(sequence) - 2, _PAIRS).astype(int)).tolist():
        pair = _matches(sequence, first)
        if pair is None:
            continue
        second, a, b = pair
        for name, path in poses.items():
            near[name].append(_epipolar_px(np.linalg.inv(path[second]) @ path[first], a, b, sequence.camera.fx))
    if sum(len(errors) for errors in near[AS_GIVEN]) < _LEAST_MATCHES:
        return AS_GIVEN, {}
    shares = {name: float(np.mean(np.concatenate(errors) < _NEAR_PX)) for name, errors in near.items()}
    most = max(shares.values())  # a straight path looks the same under two of them
    best = " or ".join(name for name, share in shares.items() if share > most - _EQUAL)
    return best if most > shares[AS_GIVEN] + _BETTER else AS_GIVEN, shares


def _matches(sequence: Sequence, first: int) -> tuple[int, FloatArray, FloatArray] | None:
    """A later frame of the same recording, and corners of both on the plane at depth 1; None where nothing moves."""
    try:
        grey = cv2.cvtColor(sequence.image(first), cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        for second in (first + step for step in _STEPS):
            if corners is None or second >= len(sequence) or sequence.recording[second] != sequence.recording[first]:
                return None
            other = cv2.cvtColor(sequence.image(second), cv2.COLOR_RGB2GRAY)
            moved, found, _ = cv2.calcOpticalFlowPyrLK(grey, other, corners, None)  # type: ignore[call-overload]
            again, back, _ = cv2.calcOpticalFlowPyrLK(other, grey, moved, None)  # type: ignore[call-overload]
            kept = (found & back).ravel().astype(bool) & (np.linalg.norm(again - corners, axis=2).ravel() < 1)
            a, b = corners[kept, 0].astype(np.float64), moved[kept, 0].astype(np.float64)
            if len(a) and np.median(np.linalg.norm(a - b, axis=1)) >= _LEAST_FLOW_PX:
                return second, on_plane(sequence.camera, a), on_plane(sequence.camera, b)
    except ImageError:
        pass
    return None


def _epipolar_px(T_second_first: FloatArray, a: FloatArray, b: FloatArray, focal_px: float) -> FloatArray:
    """Sampson distances, in pixels, of points (n, 2) on the planes at depth 1 of two frames."""
    R, (x, y, z) = T_second_first[:3, :3], T_second_first[:3, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    a, b = (np.column_stack((points, np.ones(len(points)))) for points in (a, b))
    lines, back = a @ E.T, b @ E
    norm = np.linalg.norm(np.column_stack((lines[:, :2], back[:, :2])), axis=1)
    return np.asarray(focal_px * np.abs(np.sum(b * lines, axis=1)) / np.maximum(norm, 1e-12))
