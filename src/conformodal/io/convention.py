"""What matched corners tell of given poses and cameras: the poses' convention, and a focal length that is not known."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory, cross_matrices
from conformodal.geometry.lens import on_plane

from .errors import DatasetError, ImageError
from .pose_files import table_of
from .reading import Note
from .recording import Recording

AS_GIVEN = "camera-to-world, OpenCV axes"
FITTED = "the focal length is an estimate"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_Y_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])
_PAIRS, _PAIRS_FOR_FOCAL, _STEPS, _CORNERS, _LEAST_MATCHES = 32, 128, (1, 2, 4, 8), 300, 200
_FLOW_PX, _FLOW_FOR_FOCAL_PX = 4.0, 16.0
_NEAR_PX = 2.0  # from the epipolar line
_BETTER, _EQUAL = 0.1, 0.02  # share of the matches
_FOCALS = np.geomspace(0.3, 6.0, 240)  # of the longer side
_USUAL_PX, _DRAWS, _LEAST_NEAR, _MOST_UNSURE = 0.5, 200, 0.4, 0.125
# Standard errors beside those of the draw: of a lens with k1 = 0.1 and a principal point 2 % off, as a share; of turns.
_NOT_MODELLED, _TURN_DEG = 0.03, 0.05


class _Matches(NamedTuple):
    """Two frames of a recording, and corners (n, 2) of both in pixels."""

    first: int
    second: int
    pixels: FloatArray
    pixels_second: FloatArray

    def motion(self, poses_se3: FloatArray) -> FloatArray:
        """``T_second_first`` of the poses (n, 4, 4) of all frames."""
        return np.asarray(np.linalg.inv(poses_se3[self.second]) @ poses_se3[self.first])


def fitting_convention(sequence: Recording) -> tuple[str, dict[str, float]]:
    """The convention under which matched corners lie on the epipolar lines of the poses, which all frames have.

    Returns
    -------
    best
        Its name; that of the given one where no other is clearly better, or the images do not tell.
    shares
        Share of the matches within 2 pixels of their epipolar line, by convention; empty where there are too few.
    """
    given = sequence.require_truth().poses_se3
    back = np.asarray(np.linalg.inv(given), dtype=np.float64)
    poses = {
        AS_GIVEN: given,
        "world-to-camera, OpenCV axes": back,
        "camera-to-world, OpenGL axes": given @ _OPENGL,
        "world-to-camera, OpenGL axes": back @ _OPENGL,
        "camera-to-world, left-handed axes with y up (Unity)": _Y_DOWN @ given @ _Y_DOWN,
    }
    for order, by in (("wxyz", -1), ("xyzw", 1)):  # a file whose order is the other one
        poses[f"quaternions {order}"] = rolled = _rolled(given, by)
        poses[f"quaternions {order}, world-to-camera"] = np.asarray(np.linalg.inv(rolled))
        poses[f"quaternions {order}, as COLMAP's world-to-camera"] = np.asarray(np.linalg.inv(_rolled(back, by)))
    near: dict[str, list[FloatArray]] = {name: [] for name in poses}
    for match in _pairs(sequence, _FLOW_PX):
        a, b = (on_plane(sequence.camera, pixels) for pixels in (match.pixels, match.pixels_second))
        for name, path in poses.items():
            near[name].append(_epipolar_px(match.motion(path), a, b, sequence.camera.fx))
    if sum(len(errors) for errors in near[AS_GIVEN]) < _LEAST_MATCHES:
        return AS_GIVEN, {}
    shares = {name: float(np.mean(np.concatenate(errors) < _NEAR_PX)) for name, errors in near.items()}
    most = max(shares.values())  # a straight path looks the same under two of them
    best = " or ".join(name for name, share in shares.items() if share > most - _EQUAL)
    return best if most > shares[AS_GIVEN] + _BETTER else AS_GIVEN, shares


def with_fitted_focal(sequence: Recording) -> Recording:
    """The sequence with the focal length under which matched corners lie best on the poses' epipolar lines.

    Its lens has no distortion, and its principal point is that of the camera. Only turns show it: a camera that moves
    straight ahead sees the same with any. A note gives the range of twice the standard error: from drawing the pairs of
    frames again, from errors of the poses beside the turns, and from lens and principal point.

    Refuses what does not determine it within 25 per cent.
    """
    if sequence.truth is None:
        raise DatasetError(f"{sequence.name}: a focal length is fitted to poses, and not all frames have one")
    camera, poses = sequence.camera, sequence.truth.poses_se3
    focals, centre = _FOCALS * max(camera.width, camera.height), (camera.cx, camera.cy)
    costs, near, turns_deg, n_matches = [], [], [], 0
    for match in _pairs(sequence, _FLOW_FOR_FOCAL_PX, _PAIRS_FOR_FOCAL):
        motion = match.motion(poses)
        turns_deg.append(np.degrees(np.arccos(np.clip(np.trace(motion[:3, :3]) / 2 - 0.5, -1, 1))))
        a, b = match.pixels - centre, match.pixels_second - centre
        errors = np.array([_epipolar_px(motion, a / f, b / f, f) for f in focals])
        costs.append(np.log1p((errors / _USUAL_PX) ** 2).sum(axis=1))  # errors of poses are no Gaussian noise
        near.append((errors < _NEAR_PX).sum(axis=1))
        n_matches += len(a)
    if n_matches < _LEAST_MATCHES:
        raise DatasetError(f"{sequence.name}: {n_matches} matched corners tell no focal length, expected more")
    best = int(np.argmin(np.sum(costs, axis=0)))
    share = float(np.sum(near, axis=0)[best] / n_matches)
    drawn = np.random.default_rng(0).multinomial(len(costs), np.full(len(costs), 1 / len(costs)), size=_DRAWS)
    drawn_again = float(np.std(np.log(focals[np.argmin(drawn @ np.array(costs), axis=1)])))
    turn_deg = float(np.median(turns_deg))
    spread = float(np.linalg.norm((drawn_again, _NOT_MODELLED, _TURN_DEG / max(turn_deg, 1e-3))))
    low, high = focals[best] * np.exp([-2 * spread, 2 * spread])
    fit = f"{focals[best]:.0f} pixels, between {low:.0f} and {high:.0f} (95 %)"
    if share < _LEAST_NEAR or spread > _MOST_UNSURE or best in (0, len(focals) - 1):
        raise DatasetError(
            f"{sequence.name}: poses and images do not tell the focal length: {fit}; {100 * share:.0f} % of the "
            f"matched corners fit it, and the camera turns by {turn_deg:.2g} degrees while they move by "
            f"{_FLOW_FOR_FOCAL_PX:g} pixels. Write camera-intrinsics.txt"
        )
    where = f"{sequence.name}: {fit}, from poses and {n_matches} matched corners; without distortion"
    fitted = replace(camera, fx=float(focals[best]), fy=float(focals[best]))
    return replace(sequence, camera=fitted, notes=(*sequence.notes, Note(FITTED, where)))


def _rolled(poses: FloatArray, by: int) -> FloatArray:
    """Poses (n, 4, 4) whose quaternions, ``wxyz``, are in another order."""
    rows = table_of(poses)
    times = np.arange(len(rows), dtype=np.float64)
    return Trajectory(times, rows[:, :3], np.roll(rows[:, 3:], by, axis=1)).poses_se3


def _pairs(sequence: Recording, least_flow_px: float, most: int = _PAIRS) -> list[_Matches]:
    """Matches of frames, evenly spread, with a later one."""
    firsts = np.unique(np.linspace(0, len(sequence) - 2, most).astype(int)).tolist()
    pairs = (_matches(sequence, first, least_flow_px) for first in firsts if first >= 0)
    return [match for match in pairs if match is not None]


def _matches(sequence: Recording, first: int, least_flow_px: float) -> _Matches | None:
    """A frame and a later one of the same recording; None where nothing moves."""
    try:
        grey = cv2.cvtColor(sequence.image(first), cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        for second in (first + step for step in _STEPS):
            if corners is None or second >= len(sequence) or sequence.recording[second] != sequence.recording[first]:
                return None
            other = cv2.cvtColor(sequence.image(second), cv2.COLOR_RGB2GRAY)
            tracked, there, _ = cv2.calcOpticalFlowPyrLK(grey, other, corners, None)  # type: ignore[call-overload]
            again, back, _ = cv2.calcOpticalFlowPyrLK(other, grey, tracked, None)  # type: ignore[call-overload]
            kept = (there & back).ravel().astype(bool) & (np.linalg.norm(again - corners, axis=2).ravel() < 1)
            a, b = corners[kept, 0].astype(np.float64), tracked[kept, 0].astype(np.float64)
            if len(a) and np.median(np.linalg.norm(a - b, axis=1)) >= least_flow_px:
                return _Matches(first, second, a, b)
    except ImageError:
        pass
    return None


def _epipolar_px(T_second_first: FloatArray, a: FloatArray, b: FloatArray, focal_px: float) -> FloatArray:
    """Sampson distances, in pixels, of points (n, 2) on the planes at depth 1 of two frames."""
    E = cross_matrices(T_second_first[:3, 3]) @ T_second_first[:3, :3]
    a, b = (np.column_stack((points, np.ones(len(points)))) for points in (a, b))
    lines, back = a @ E.T, b @ E
    norm = np.linalg.norm(np.column_stack((lines[:, :2], back[:, :2])), axis=1)
    return np.asarray(focal_px * np.abs(np.sum(b * lines, axis=1)) / np.maximum(norm, 1e-12))
