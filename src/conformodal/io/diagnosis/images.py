"""What matched corners tell of given poses and cameras: whether poses fit the images, and if not, why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import PinholeCamera, Trajectory, cross_matrices, poses_at
from conformodal.geometry.lens import on_plane
from conformodal.geometry.poses import table_of
from conformodal.io.decoding import grey_image
from conformodal.io.errors import ImageError
from conformodal.io.recording import Recording

from .axes import OPENCV, advise_axes, describe_axes, is_usual, name_axes, name_world_axes, signed_permutations
from .cause import Cause
from .flow import corners_of, flow_px, tracked_corners
from .stale import repeated_poses

_PAIRS, _STEPS, _MIN_MATCHES = 32, (1, 2, 4, 8), 200
_FLOW_PX = 4.0
NEAR_PX = 2.0  # from the epipolar line
# Shares of the matches near their line. Poses by motion capture, fusion or rendering have 0.89 to 1.00 as they are,
# 0.27 to 0.66 a tenth of a second late and 0.09 to 0.34 a second late (TUM fr1, 7-Scenes, ICL-NUIM).
FITS, _FITS_NOT, _BETTER, _EQUAL = 0.8, 0.5, 0.1, 0.02
# Of these, before both cameras: 0.93 to 1.00 where poses fit, 0.00 to 0.07 where images are mirrored.
_PARALLAX_PX, _BEHIND, _MIN_SEEN = 3.0, 0.3, 100
_PEAK = 0.25  # of a shift that fits above the usual one
_MAX_SHIFT_S, _SHIFTS = 10.0, 401
_FOCALS = np.geomspace(0.3, 6.0, 120)  # of the longer side
_OFTEN = 0.25  # of positions that repeat while orientations do not
_OFF_CENTRE = 0.05  # of the image's side
_SEARCHED, _MAX_TRIED = 3, 48  # every third match tells enough of a turn; of those, so many are tried by all matches
_MAX_NAMES = 3
_ORDER_REMEDY = "name the columns in the head of the pose file, such as '# timestamp tx ty tz {}'"


@dataclass(frozen=True, eq=False)
class _Matches:
    """Pairs of frames of a recording, and the corners that both show."""

    frames: IntArray  # (p, 2)
    pixels: FloatArray  # (p, k, 2, 2) in the first frame and in the second; NaN behind the last

    @property
    def n_matches(self) -> int:
        return int(np.isfinite(self.pixels[..., 0, 0]).sum())


class Motions(NamedTuple):
    """``T_second_first`` of pairs; NaN where a frame has no pose."""

    rotations: FloatArray  # (..., p, 3, 3)
    translations: FloatArray  # (..., p, 3)


class _PoseReading(NamedTuple):
    """The numbers of the poses, read in some way."""

    poses: FloatArray  # (n, 4, 4) of the frames
    what: str
    remedy: str


class _Change(NamedTuple):
    """A change of poses or camera under which they may fit the images."""

    share: float  # of the matches near their line
    what: str
    remedy: str
    before: float = np.nan  # share of these before both cameras
    rank: int = 0  # of several that fit alike: the lowest is the most usual

    @property
    def fit(self) -> float:
        """Share of the matches near their line whose points are before both cameras, as far as that can be told."""
        return _fit(self.share, self.before)


def _fit(share: float, before: float) -> float:
    return share if np.isnan(before) else share * before


def diagnose_poses(recording: Recording) -> Cause | None:
    """Why matched corners do not lie on the epipolar lines of the poses, before both cameras; None where they do.

    Tried are, from the cheapest on: another focal length, other axes of the camera, of mirrored images and of the
    positions' world, the inverse poses, another order of quaternions, and poses that are late or early. The first wins
    that is as good as the best of them. A focal length that is only a little off is told as well.
    """
    matches = _match_pairs(recording) if recording.poses is not None and len(recording.poses) > 1 else None
    if matches is None or recording.poses is None or matches.n_matches < _MIN_MATCHES:
        return None
    camera = recording.camera
    rays = as_rays(on_plane(camera, matches.pixels.reshape(-1, 2)).reshape(matches.pixels.shape))
    motions = _motions(recording.poses.poses_se3, matches)
    given = float(_shares_near(motions, rays, camera.fx))
    before = _share_before(motions, rays, camera.fx)
    near = f"as read, {100 * given:.0f} % of the matched corners are within {NEAR_PX:g} px of their epipolar line"
    if given >= _FITS_NOT and before < _BEHIND:
        near += f", and {100 * (1 - before):.0f} % of these points lie behind the camera"
        return _told(_best_axes(recording.poses.poses_se3, matches, rays, camera), near)
    if given < FITS and (repeats := _parts_that_repeat(recording.poses)):
        return Cause(repeats, near, "give both of one rate, interpolated to the images' times")
    if given > 1 - _BETTER and not before < 1 - _BETTER:
        return None
    return _explain(recording.poses, camera, matches, rays, motions, near)


def _explain(
    truth: Trajectory, camera: PinholeCamera, matches: _Matches, rays: FloatArray, motions: Motions, near: str
) -> Cause | None:
    """The best of changes of camera and poses, if it is better than none; `near` says how the poses fit as read."""
    before = _share_before(motions, rays, camera.fx)
    given = _fit(float(_shares_near(motions, rays, camera.fx)), before)
    changes = [_best_focal(camera, matches, motions), _best_axes(truth.poses_se3, matches, rays, camera)]
    if max(given, *(change.fit for change in changes)) < FITS:
        changes.append(_best_shift(truth, matches, rays, camera.fx))
    # of a change whose points cannot be placed, as many are taken to be before the cameras as are as read
    fits = [_fit(change.share, before) if np.isnan(change.before) else change.fit for change in changes]
    most = max(fits)
    if most >= max(_FITS_NOT, given + _BETTER):
        return _told(next(change for change, fit in zip(changes, fits, strict=True) if fit > most - _EQUAL), near)
    if given >= _FITS_NOT:
        return None
    return Cause(
        "the poses belong to other images, or are very inexact",
        f"{near}, and no more than {100 * most:.0f} % with another focal length, other axes or order of numbers, or "
        f"poses up to {_MAX_SHIFT_S:g} s later or earlier",
        "check which poses and images belong together",
    )


def _parts_that_repeat(poses: Trajectory) -> str:
    """Whether positions repeat to the last bit while orientations change, or the other way round; else nothing."""
    positions, orientations = repeated_poses(poses.positions_xyz), repeated_poses(poses.orientations_quat_wxyz)
    parts = {"positions": positions & ~orientations, "orientations": orientations & ~positions}
    part = max(parts, key=lambda name: int(parts[name].sum()))
    share = float(parts[part].mean())
    if share < _OFTEN:
        return ""
    return f"{part} repeat to the last bit in {100 * share:.0f} % of the poses, whose other numbers change"


def _told(change: _Change, as_read: str) -> Cause:
    before = "" if np.isnan(change.before) else f", {100 * change.before:.0f} % of these before the camera"
    return Cause(change.what, f"{as_read}; so, {100 * change.share:.0f} %{before}", change.remedy)


def _best_shift(truth: Trajectory, matches: _Matches, rays: FloatArray, focal_px: float) -> _Change:
    """The poses of another time that fit best."""
    times = truth.timestamps_s
    step = float(np.median(np.diff(times)))
    asked = times[matches.frames].ravel()
    in_order = _Matches(np.arange(asked.size).reshape(-1, 2), matches.pixels)

    def motions_at(shift_s: float) -> Motions:
        rows = poses_at(truth, asked + shift_s, 5 * step).rows
        inside = np.isfinite(rows).all(axis=1)
        path = np.full((asked.size, 4, 4), np.nan)
        path[inside] = Trajectory(asked[inside], rows[inside, :3], rows[inside, 3:]).poses_se3
        return _motions(path, in_order)

    def share_at(shift_s: float) -> float:
        return float(_shares_near(motions_at(shift_s), rays, focal_px))

    longest = min(_MAX_SHIFT_S, float(np.ptp(times)) / 2)
    shifts = np.linspace(-longest, longest, _SHIFTS)
    coarse = [share_at(shift) for shift in shifts]
    best = shifts[np.argmax(coarse)]
    closer = best + np.linspace(-1, 1, 21) * (shifts[1] - shifts[0])
    shares = [share_at(shift) for shift in closer]
    best, share = float(closer[np.argmax(shares)]), max(shares)
    if share < np.median(coarse) + _PEAK:  # the best of many by chance
        share = 0.0
    side = "late" if best > 0 else "early"
    what = f"poses seem to be {abs(best):.3g} s ({abs(best) / step:.3g} frames) too {side} for the images"
    before = _share_before(motions_at(best), rays, focal_px)
    return _Change(share, what, "shift their times, or the lines of the file", before)


def _best_focal(camera: PinholeCamera, matches: _Matches, motions: Motions) -> _Change:
    """The focal length that fits best, or the given one where that is hardly worse."""
    focals = _FOCALS * max(camera.width, camera.height)
    centred = as_rays(matches.pixels - (camera.cx, camera.cy))
    shares = [float(_shares_near(motions, centred / [focal, focal, 1], focal)) for focal in focals.tolist()]
    low, high = focals[np.flatnonzero(np.array(shares) > max(shares) - _EQUAL)[[0, -1]]]
    what = f"the poses imply a focal length of {low:.0f} to {high:.0f} px where {camera.fx:.0f} px is given"
    focal = float(focals[np.argmax(shares)])
    before = _share_before(motions, centred / [focal, focal, 1], focal)
    return _Change(max(shares), what, "check the camera", before)


def _best_axes(poses_se3: FloatArray, matches: _Matches, rays: FloatArray, camera: PinholeCamera) -> _Change:
    """The axes, and way to read the poses, that fit best; a straight path looks the same under some of them.

    Axes of one class have the same epipolar lines as their opposites: a turn, and the mirrored axes that point the
    other way. Which of both it is, points before the camera tell. Of those that fit alike, usual ones are named first.
    """
    readings = _readings(poses_se3)
    turns = np.array(signed_permutations(proper=True))
    still = np.eye(3)[None]
    centre = np.array([camera.width - 1, camera.height - 1]) / 2
    views = [(rays, False)]
    if (np.abs((camera.cx, camera.cy) - centre) > _OFF_CENTRE * np.array([camera.width, camera.height])).any():
        views.append((as_rays((matches.pixels - centre) / (camera.fx, camera.fy)), True))
    found, most = list[_Change](), -1.0
    for tier, worlds in ((readings[:2], still), (readings[2:], still), (readings[:2], turns)):
        for view, in_middle in views if most < FITS else []:
            fitting = _fitting(tier, worlds, turns, matches, view, camera.fx, centred=in_middle)
            if max(change.fit for change in fitting) > most + _EQUAL:
                found, most = fitting, max(change.fit for change in fitting)
    same = sorted((change for change in found if change.fit > most - _EQUAL), key=lambda change: change.rank)
    whats = list(dict.fromkeys(change.what for change in same))
    what = " or ".join(whats[:_MAX_NAMES]) + (f", or {len(whats) - _MAX_NAMES} others" * (len(whats) > _MAX_NAMES))
    remedies = list(dict.fromkeys(change.remedy for change in same))[:_MAX_NAMES]
    remedy = "; or: ".join(remedies) + "; images of such a path cannot tell which" * (len(remedies) > 1)
    told = f"they fit with {what}, where camera-to-world and OpenCV's axes are assumed"
    if len(whats) > 1:
        told += f"; {whats[0]} is the most usual of {len(whats)} that fit alike"
    return same[0]._replace(what=told, remedy=remedy)


def _fitting(
    readings: list[_PoseReading],
    worlds: FloatArray,
    turns: FloatArray,
    matches: _Matches,
    rays: FloatArray,
    focal_px: float,
    *,
    centred: bool,
) -> list[_Change]:
    """Turns of axes (t, 3, 3), of the positions' worlds (w, 3, 3) and readings that are nearly as good as the best."""
    tried, shares = list[tuple[_PoseReading, FloatArray, FloatArray]](), list[float]()
    few = rays[:, ::_SEARCHED]
    for reading in readings:
        for world in worlds:
            motions = _motions(reading.poses, matches, world)
            shares += _shares_near(_turned(motions, turns[:, None]), few, focal_px).tolist()
            tried += [(reading, world, turn) for turn in turns]
    # those that are as good as the best by fewer matches, by all of them
    found = list[_Change]()
    for i in np.flatnonzero(np.array(shares) > max(shares) - 3 * _EQUAL)[:_MAX_TRIED].tolist():
        reading, world, turn = tried[i]
        motions = _turned(_motions(reading.poses, matches, world), turn)
        share, before = float(_shares_near(motions, rays, focal_px)), _share_before(motions, rays, focal_px)
        sign = -1.0 if before < 0.5 else 1.0  # NaN is neither
        before = 1 - before if sign < 0 else before
        of_world = not np.array_equal(world, np.eye(3))
        axes, world_axes = (turn.T, sign * world) if of_world else (sign * turn.T, world)
        found.append(_described(share, before, reading, axes, world_axes if of_world else None, centred=centred))
    return found


def _described(
    share: float, before: float, reading: _PoseReading, axes: FloatArray, world: FloatArray | None, *, centred: bool
) -> _Change:
    """A change in words."""
    parts, remedies = [reading.what], [reading.remedy]
    axes_are_opencv = name_axes(axes) == OPENCV
    if not axes_are_opencv:
        parts.append(describe_axes(axes))
        remedies.append(advise_axes(axes))
    if world is not None:
        name = name_world_axes(world)
        parts.append(f"{name} of the positions as x,y,z of the orientations' world")
        remedies.append(f"'conformodal data convert --world-axes {name}' turns the positions")
    if centred:
        parts.append("the principal point in the middle of the images")
        remedies.append("check the camera")
    rank = 3 * (world is not None) + bool(reading.what) + (0 if axes_are_opencv else 1 if is_usual(axes) else 3)
    return _Change(share, " and ".join(filter(None, parts)), "; ".join(filter(None, remedies)), before, rank)


def _readings(poses_se3: FloatArray) -> list[_PoseReading]:
    """Poses (n, 4, 4) as they are, inverse, and with quaternions whose order is another one."""
    back = np.asarray(np.linalg.inv(poses_se3))
    invert = "'conformodal data convert --world-to-camera' inverts them"
    readings = [_PoseReading(poses_se3, "", ""), _PoseReading(back, "world-to-camera poses", invert)]
    for order, by in (("wxyz", -1), ("xyzw", 1)):  # a file whose order is the other one
        head = _ORDER_REMEDY.format(" ".join(f"q{letter}" for letter in order))
        rolled = _rolled(poses_se3, by)
        inverse = np.asarray(np.linalg.inv(_rolled(back, by)))
        readings += [
            _PoseReading(rolled, f"quaternions {order}", head),
            _PoseReading(
                np.asarray(np.linalg.inv(rolled)), f"world-to-camera quaternions {order}", f"{head}; {invert}"
            ),
            _PoseReading(inverse, f"quaternions {order} of COLMAP's world-to-camera poses", head),
        ]
    return readings


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
    padded = np.full((len(frames), max(map(len, pixels)), 2, 2), np.nan)
    for row, part in zip(padded, pixels, strict=True):
        row[: len(part)] = part
    return _Matches(np.array(frames), padded)


class _LaterFrame(NamedTuple):
    step: int  # frames
    pixels: FloatArray  # (m, 2, 2) corners in both


def _match_later_frame(recording: Recording, frames: list[int]) -> _LaterFrame | None:
    """A later frame of the first one's recording in which corners have moved; None where nothing moves."""
    number = recording.recording[frames[0]]
    try:
        grey = grey_image(recording.image(frames[0]))
        corners = corners_of(grey)
        for step in _STEPS:
            if corners is None or step >= len(frames) or recording.recording[frames[step]] != number:
                return None
            pixels = tracked_corners(grey, grey_image(recording.image(frames[step])), corners)
            if pixels is None or flow_px(pixels) >= _FLOW_PX:
                return None if pixels is None else _LaterFrame(step, pixels)
    except ImageError:
        pass
    return None


def as_rays(plane: FloatArray) -> FloatArray:
    """Points (..., 2) of the plane at depth 1 as (..., 3)."""
    return np.concatenate((plane, np.ones((*plane.shape[:-1], 1))), axis=-1)


def _motions(poses_se3: FloatArray, matches: _Matches, world: FloatArray | None = None) -> Motions:
    """Motions of pairs under the poses (n, 4, 4) of all frames, whose positions may be turned (3, 3)."""
    first, second = poses_se3[matches.frames.T]
    back = np.swapaxes(second[:, :3, :3], 1, 2)
    apart = first[:, :3, 3] - second[:, :3, 3]
    apart = apart if world is None else apart @ world.T
    return Motions(back @ first[:, :3, :3], (back @ apart[..., None])[..., 0])


def _turned(motions: Motions, turns: FloatArray) -> Motions:
    """Motions of cameras of turned axes (..., 3, 3): columns of a turn are the camera's axes in those given."""
    back = np.swapaxes(turns, -1, -2)
    return Motions(back @ motions.rotations @ turns, (back @ motions.translations[..., None])[..., 0])


def _shares_near(motions: Motions, rays: FloatArray, focal_px: float) -> FloatArray:
    """Shares (...) of the matches near their epipolar line; 0 where most of the pairs have no poses.

    `rays` (p, k, 2, 3) are the matches' in both frames.
    """
    errors = epipolar_px(motions, rays, focal_px)
    compared = np.isfinite(errors).sum(axis=(-1, -2))
    near = (errors < NEAR_PX).sum(axis=(-1, -2)) / np.maximum(compared, 1)
    return np.asarray(np.where(2 * compared > np.isfinite(rays[..., 0, 0]).sum(), near, 0.0))


def epipolar_px(motions: Motions, rays: FloatArray, focal_px: float) -> FloatArray:
    """Sampson distances (..., p, k), in pixels, of matches (p, k, 2, 3)."""
    E = cross_matrices(motions.translations) @ motions.rotations
    a, b = rays[:, :, 0], rays[:, :, 1]
    lines, back = a @ np.swapaxes(E, -1, -2), b @ E
    norm = np.sqrt((lines[..., :2] ** 2).sum(axis=-1) + (back[..., :2] ** 2).sum(axis=-1))
    errors = focal_px * np.abs((b * lines).sum(axis=-1)) / np.maximum(norm, 1e-12)
    still = (motions.translations == 0).all(axis=-1)
    if still.any():  # no epipolar lines: a camera that turns alone moves all points by its rotation
        turned = a @ np.swapaxes(motions.rotations, -1, -2)
        apart = turned[..., :2] / turned[..., 2:] - b[..., :2] / b[..., 2:]
        errors = np.where(still[..., None], focal_px * np.linalg.norm(apart, axis=-1), errors)
    return np.asarray(errors)


def _share_before(motions: Motions, rays: FloatArray, focal_px: float) -> float:
    """Share of the matches near their line, and with parallax, whose point lies before both cameras; NaN of few."""
    near = epipolar_px(motions, rays, focal_px) < NEAR_PX
    a = rays[:, :, 0] @ np.swapaxes(motions.rotations, -1, -2)
    b = rays[:, :, 1]
    across = np.cross(a, b)
    to = np.broadcast_to(motions.translations[:, None], b.shape)
    # depths, apart from their positive scale, in the first frame and in the second
    first, second = (across * np.cross(b, to)).sum(axis=-1), (across * np.cross(a, to)).sum(axis=-1)
    parallax = focal_px * np.linalg.norm(across, axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    seen = near & (parallax > _PARALLAX_PX)
    return float(np.mean((first > 0) & (second > 0), where=seen)) if seen.sum() >= _MIN_SEEN else np.nan
