"""What matched corners tell of given poses and cameras: whether poses fit the images, why not, and a focal length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import PinholeCamera, Trajectory, cross_matrices, poses_at
from conformodal.geometry.lens import on_plane

from .errors import ImageError
from .pose_files import table_of
from .recording import Recording

AS_GIVEN = "camera-to-world, OpenCV axes"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_Y_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])
_OF_BODY = np.eye(4)[[2, 0, 1, 3]] * [[1.0], [-1.0], [-1.0], [1.0]]  # a camera that looks along x, z up
_PAIRS, _STEPS, _CORNERS, _LEAST_MATCHES = 32, (1, 2, 4, 8), 300, 200
_FLOW_PX = 4.0
_LEAST_TRACKED = 0.5  # of the corners: where frames are so far apart that most are lost, many of the others are wrong
_NEAR_PX = 2.0  # from the epipolar line
# Shares of the matches near their line. Poses by motion capture, fusion or rendering have 0.89 to 1.00 as they are,
# 0.27 to 0.66 a tenth of a second late and 0.09 to 0.34 a second late (TUM fr1, 7-Scenes, ICL-NUIM).
_FITS, _FITS_NOT, _BETTER, _EQUAL = 0.8, 0.5, 0.1, 0.02
_PEAK = 0.25  # of a shift that fits above the usual one
_LONGEST_SHIFT_S, _SHIFTS = 10.0, 401
_FOCALS = np.geomspace(0.3, 6.0, 120)  # of the longer side


@dataclass(frozen=True, eq=False)
class _Matches:
    """Pairs of frames of a recording, and the corners that both show."""

    frames: IntArray  # (p, 2)
    pair: IntArray  # (m,) of each match
    pixels: FloatArray  # (m, 2, 2) in the first frame and in the second

    def __len__(self) -> int:
        return len(self.pair)

    def motions(self, poses_se3: FloatArray) -> FloatArray:
        """``T_second_first`` (p, 4, 4) of the poses (n, 4, 4) of all frames; NaN where a pose is."""
        first, second = poses_se3[self.frames.T]
        return np.asarray(np.linalg.inv(second) @ first)


@dataclass(frozen=True)
class _Change:
    """A change of poses or camera under which they may fit the images."""

    share: float
    advice: str


def doubt_poses(recording: Recording) -> str:
    """Why matched corners do not lie on the epipolar lines of the poses, and what to do; nothing where they do.

    Poses that are late or early, another focal length, and another convention are tried in this order: the first wins
    that is as good as the best of them. A focal length that is only a little off is told as well.
    """
    matches = _match_pairs(recording) if recording.poses is not None and len(recording.poses) > 1 else None
    if matches is None or recording.poses is None or len(matches) < _LEAST_MATCHES:
        return ""
    poses, camera = recording.poses.poses_se3, recording.camera
    plane = on_plane(camera, matches.pixels.reshape(-1, 2)).reshape(-1, 2, 2)

    def share_of(path: FloatArray) -> float:
        return _share_near(matches, matches.motions(path), plane, camera.fx)

    given = share_of(poses)
    changes = [_best_focal(camera, matches, poses), _best_convention(poses, share_of)]
    if given < _FITS:
        changes.insert(0, _best_shift(recording.poses, matches, plane, camera.fx))
    most = max(change.share for change in changes)
    near = f"{100 * given:.0f} % of the matched corners are within {_NEAR_PX:g} px of their epipolar line"
    if most >= max(_FITS_NOT, given + _BETTER):
        best = next(change for change in changes if change.share > most - _EQUAL)
        return f"{best.advice} (as read, {near}; so, {100 * best.share:.0f} %)"
    if given >= _FITS_NOT:
        return ""
    return (
        f"{near}, and no more than {100 * most:.0f} % with poses up to {_LONGEST_SHIFT_S:g} s later or earlier, "
        "another focal length, or another convention: the poses belong to other images, or are very inexact"
    )


def _best_shift(truth: Trajectory, matches: _Matches, plane: FloatArray, focal_px: float) -> _Change:
    """The poses of another time that fit best."""
    times = truth.timestamps_s
    step = float(np.median(np.diff(times)))
    asked = times[matches.frames].ravel()
    in_order = replace(matches, frames=np.arange(asked.size).reshape(-1, 2))

    def share_at(shift_s: float) -> float:
        rows = poses_at(truth, asked + shift_s, 5 * step).rows
        inside = np.isfinite(rows).all(axis=1)
        path = np.full((asked.size, 4, 4), np.nan)
        path[inside] = Trajectory(asked[inside], rows[inside, :3], rows[inside, 3:]).poses_se3
        return _share_near(in_order, in_order.motions(path), plane, focal_px)

    longest = min(_LONGEST_SHIFT_S, float(np.ptp(times)) / 2)
    shifts = np.linspace(-longest, longest, _SHIFTS)
    coarse = [share_at(shift) for shift in shifts]
    best = shifts[np.argmax(coarse)]
    closer = best + np.linspace(-1, 1, 21) * (shifts[1] - shifts[0])
    shares = [share_at(shift) for shift in closer]
    best, share = float(closer[np.argmax(shares)]), max(shares)
    if share < np.median(coarse) + _PEAK:  # the best of many by chance
        share = 0.0
    side = "late" if best > 0 else "early"
    return _Change(
        share,
        f"poses seem to be {abs(best):.3g} s ({abs(best) / step:.3g} frames) too {side} for the images: shift their "
        "times, or the lines of the file",
    )


def _best_focal(camera: PinholeCamera, matches: _Matches, poses_se3: FloatArray) -> _Change:
    """The focal length that fits best, or the given one where that is hardly worse."""
    motions = matches.motions(poses_se3)
    focals = _FOCALS * max(camera.width, camera.height)
    centred = matches.pixels - (camera.cx, camera.cy)
    shares = [_share_near(matches, motions, centred / focal, focal) for focal in focals]
    low, high = focals[np.flatnonzero(np.array(shares) > max(shares) - _EQUAL)[[0, -1]]]
    advice = f"the poses imply a focal length of {low:.0f} to {high:.0f} px where {camera.fx:.0f} px is given"
    return _Change(max(shares), f"{advice}: check the camera")


def _best_convention(poses_se3: FloatArray, share_of: Callable[[FloatArray], float]) -> _Change:
    """The conventions that fit best; a straight path looks the same under two of them."""
    back = np.asarray(np.linalg.inv(poses_se3))
    conventions = {
        "world-to-camera, OpenCV axes": back,
        "camera-to-world, OpenGL axes": poses_se3 @ _OPENGL,
        "world-to-camera, OpenGL axes": back @ _OPENGL,
        "camera-to-world, left-handed axes with y up (Unity)": _Y_DOWN @ poses_se3 @ _Y_DOWN,
        "those of a body with x forward and z up (ROS)": poses_se3 @ _OF_BODY,
    }
    for order, by in (("wxyz", -1), ("xyzw", 1)):  # a file whose order is the other one
        conventions[f"quaternions {order}"] = rolled = _rolled(poses_se3, by)
        conventions[f"quaternions {order}, world-to-camera"] = np.asarray(np.linalg.inv(rolled))
        conventions[f"quaternions {order}, as COLMAP's world-to-camera"] = np.asarray(np.linalg.inv(_rolled(back, by)))
    shares = {name: share_of(path) for name, path in conventions.items()}
    most = max(shares.values())
    names = " or ".join(name for name, share in shares.items() if share > most - _EQUAL)
    return _Change(most, f"poses fit the images as {names}, and are read as {AS_GIVEN}")


def _rolled(poses: FloatArray, by: int) -> FloatArray:
    """Poses (n, 4, 4) whose quaternions, ``wxyz``, are in another order."""
    rows = table_of(poses)
    times = np.arange(len(rows), dtype=np.float64)
    return Trajectory(times, rows[:, :3], np.roll(rows[:, 3:], by, axis=1)).poses_se3


def _match_pairs(recording: Recording) -> _Matches | None:
    """Matches of frames that have a pose, evenly spread, with a later one; None where no frame moves."""
    posed = recording.posed.tolist()
    frames, pixels = [], []
    for first in np.unique(np.linspace(0, len(posed) - 2, _PAIRS).astype(int)).tolist():
        matched = _match_later_frame(recording, posed[first:])
        if matched is not None:
            frames.append((first, first + matched.step))
            pixels.append(matched.pixels)
    if not frames:
        return None
    pair = np.repeat(np.arange(len(frames)), [len(part) for part in pixels])
    return _Matches(np.array(frames), pair, np.concatenate(pixels))


class _LaterFrame(NamedTuple):
    step: int  # frames
    pixels: FloatArray  # (m, 2, 2) corners in both


def _match_later_frame(recording: Recording, frames: list[int]) -> _LaterFrame | None:
    """A later frame of the first one's recording in which corners have moved; None where nothing moves."""
    number = recording.recording[frames[0]]
    try:
        grey = cv2.cvtColor(recording.image(frames[0]), cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        for step in _STEPS:
            if corners is None or step >= len(frames) or recording.recording[frames[step]] != number:
                return None
            other = cv2.cvtColor(recording.image(frames[step]), cv2.COLOR_RGB2GRAY)
            tracked, there, _ = cv2.calcOpticalFlowPyrLK(grey, other, corners, None)  # type: ignore[call-overload]
            again, back, _ = cv2.calcOpticalFlowPyrLK(other, grey, tracked, None)  # type: ignore[call-overload]
            kept = (there & back).ravel().astype(bool) & (np.linalg.norm(again - corners, axis=2).ravel() < 1)
            pixels = np.stack((corners[kept, 0], tracked[kept, 0]), axis=1).astype(np.float64)
            if kept.mean() < _LEAST_TRACKED:
                return None
            if np.median(np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)) >= _FLOW_PX:
                return _LaterFrame(step, pixels)
    except ImageError:
        pass
    return None


def _share_near(matches: _Matches, motions: FloatArray, plane: FloatArray, focal_px: float) -> float:
    """Share of the matches near their epipolar line; 0 where most of the pairs have no poses."""
    errors = _epipolar_px(matches, motions, plane, focal_px)
    compared = np.isfinite(errors)
    return float(np.mean(errors[compared] < _NEAR_PX)) if compared.mean() > 0.5 else 0.0


def _epipolar_px(matches: _Matches, motions: FloatArray, plane: FloatArray, focal_px: float) -> FloatArray:
    """Sampson distances (m,), in pixels, of points (m, 2, 2) on the planes at depth 1 of two frames."""
    E = (cross_matrices(motions[:, :3, 3]) @ motions[:, :3, :3])[matches.pair]
    a, b = np.moveaxis(np.concatenate((plane, np.ones((len(plane), 2, 1))), axis=2), 1, 0)
    lines, back = np.einsum("mij,mj->mi", E, a), np.einsum("mij,mi->mj", E, b)
    norm = np.linalg.norm(np.column_stack((lines[:, :2], back[:, :2])), axis=1)
    return np.asarray(focal_px * np.abs(np.sum(b * lines, axis=1)) / np.maximum(norm, 1e-12))
