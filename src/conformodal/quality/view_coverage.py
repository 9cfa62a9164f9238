"""Where a recording is sparse: views far from every known one, and neighbouring frames that are far apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.words import listed
from conformodal.poses import Trajectory, angle_between_quats, matrix_from_quat_wxyz

from .settings import QUALITY
from .views import KnownViews, Nearest, Stations, ViewScale, stations

_SIDES = (("right", "left"), ("down", "up"), ("forward", "back"))
TILTED = "tilted"
_SHARE = 0.5  # of the largest part of a turn or a way that another part is named from


@dataclass(frozen=True)
class SparseStretch:
    """Neighbouring frames whose views are far from every known one; places are in metres.

    Attributes
    ----------
    first, last
        Frames.
    between
        Whether only ways between neighbouring frames are sparsely covered, and no frame itself.
    place_xyz, change
        Where the nearest known view is farthest, and how far: a share of the view, see :class:`ViewScale`.
    nearest
        The known view that is nearest there, by its place among the known; -1 where nothing is known.
    distance_m, angle_deg
        How far off it is; infinite where nothing is known.
    turned, moved
        In which direction the camera looks and stands from there, in words; empty where it hardly differs.
    way
        How much the view changes along the stretch.
    """

    first: int
    last: int
    between: bool
    place_xyz: tuple[float, float, float]
    change: float
    nearest: int
    distance_m: float
    angle_deg: float
    turned: str
    moved: str
    way: float


@dataclass(frozen=True)
class FastStretch:
    """Neighbouring frames between which the view changes much.

    Attributes
    ----------
    first, last
        Frames.
    place_xyz
        Of the largest step.
    change, distance_m, angle_deg
        Of the largest step.
    turning
        Whether turns make up more of the steps than ways.
    """

    first: int
    last: int
    place_xyz: tuple[float, float, float]
    change: float
    distance_m: float
    angle_deg: float
    turning: bool


@dataclass(frozen=True, eq=False)
class PoseCoverage:
    """What poses alone say of n frames.

    Attributes
    ----------
    change
        (n,) how much each frame's view differs from the nearest known one.
    sparse_frames
        (n,) whether it is more than the limit.
    sparse, fast
        Stretches, in the order of time.
    """

    change: FloatArray
    sparse_frames: BoolArray
    sparse: list[SparseStretch]
    fast: list[FastStretch]


def pose_coverage(poses: Trajectory, recording: IntArray, known: Trajectory, scale: ViewScale) -> PoseCoverage:
    """Compare the views along the path of a camera with those of known frames.

    Poses are in order of time, with the number (n,) of each one's recording. A known frame covers itself, but not the
    way to the next known frame.
    """
    way, views = stations(poses, recording, scale), KnownViews(known, scale)
    found = views.nearest(way.views)
    sparse = found.change > QUALITY.sparse
    own = recording[np.floor(way.at).astype(np.int64)] if len(way.at) else np.empty(0, dtype=np.int64)
    stretches = [_sparse(run, way, found, views) for run in runs_of(sparse, way.at, own)]
    whole = np.flatnonzero(way.at == np.floor(way.at))
    return PoseCoverage(found.change[whole], sparse[whole], stretches, _fast(poses, recording, scale, stretches))


def runs_of(chosen: BoolArray, at: FloatArray | IntArray, recording: IntArray) -> Iterator[IntArray]:
    """Runs (m,) of chosen places of one recording, by the frame (n,) of each; short gaps do not end a run."""
    places = np.flatnonzero(chosen)
    if places.size:
        apart = (np.diff(at[places]) > QUALITY.bridged + 1) | (np.diff(recording[places]) != 0)
        yield from np.split(places, np.flatnonzero(apart) + 1)


def _sparse(run: IntArray, way: Stations, found: Nearest, views: KnownViews) -> SparseStretch:
    at, poses, scale = way.at[run], way.views[run], views.scale
    frames = at[at == np.floor(at)]
    between = frames.size == 0
    first, last = (np.floor(at[0]), np.ceil(at[-1])) if between else (frames[0], frames[-1])
    worst = int(run[np.argmax(found.change[run])])
    view, nearest, change = way.views[worst : worst + 1], int(found.index[worst]), float(found.change[worst])
    metres, angle, turned, moved = np.inf, np.inf, "", ""
    if nearest >= 0:
        known = views.poses[nearest : nearest + 1]
        metres = float(np.linalg.norm(view.positions_xyz - known.positions_xyz))
        angle = float(angle_between_quats(view.orientations_quat_wxyz, known.orientations_quat_wxyz)[0])
        turned, moved = _directions(known, view)
        # a turn or a step is named if it changes the view much
        turned = turned if angle / scale.fov_rad > _SHARE * change else ""
        moved = moved if metres / scale.depth_m / scale.fov_rad > _SHARE * change else ""
    x, y, z = view.positions_xyz[0].tolist()
    return SparseStretch(
        first=int(first),
        last=int(last),
        between=between,
        place_xyz=(x, y, z),
        change=change,
        nearest=nearest,
        distance_m=metres,
        angle_deg=float(np.degrees(angle)),
        turned=turned,
        moved=moved,
        way=float(scale.change(poses[:-1], poses[1:]).sum()),
    )


def _directions(known: Trajectory, view: Trajectory) -> tuple[str, str]:
    """Directions in which the camera of `view` looks and stands, seen from that of `known`."""
    R_world_known = matrix_from_quat_wxyz(known.orientations_quat_wxyz)[0]
    R_known_view = R_world_known.T @ matrix_from_quat_wxyz(view.orientations_quat_wxyz)[0]
    moved = R_world_known.T @ (view.positions_xyz - known.positions_xyz)[0]
    aside, turn = R_known_view[:2, 2], np.arccos(np.clip((np.trace(R_known_view) - 1) / 2, -1, 1))
    if np.linalg.norm(aside) < _SHARE * np.sin(turn):  # it turned about its own line of sight
        return TILTED, _in_words(moved)
    return _in_words(np.array([*aside, 0.0])), _in_words(moved)


def _in_words(way: FloatArray) -> str:
    """The sides that a vector in the camera's frame (x right, y down, z forward) points to."""
    largest = float(np.abs(way).max())
    named = [
        side[0] if part > 0 else side[1]
        for part, side in zip(way.tolist(), _SIDES, strict=True)
        if largest > 0 and abs(part) > _SHARE * largest
    ]
    return listed(named)


def _fast(poses: Trajectory, recording: IntArray, scale: ViewScale, sparse: list[SparseStretch]) -> list[FastStretch]:
    """Steps that are larger than the limit, but those within sparse stretches, which are to be recorded anyway."""
    if len(poses) < 2:
        return []
    before, after = poses[:-1], poses[1:]
    change = scale.change(before, after)
    metres = np.linalg.norm(after.positions_xyz - before.positions_xyz, axis=1)
    turned = angle_between_quats(before.orientations_quat_wxyz, after.orientations_quat_wxyz)
    fast = (change > QUALITY.fast) & (np.diff(recording) == 0)
    for gap in sparse:
        fast[gap.first : gap.last] = False
    found = []
    for run in runs_of(fast, np.arange(len(fast)), recording[:-1]):
        steps = run[fast[run]]
        worst = int(steps[np.argmax(change[steps])])
        x, y, z = ((before.positions_xyz[worst] + after.positions_xyz[worst]) / 2).tolist()
        turning = bool(turned[steps].sum() > metres[steps].sum() / scale.depth_m)
        size = float(change[worst]), float(metres[worst]), float(np.degrees(turned[worst]))
        found.append(FastStretch(int(steps[0]), int(steps[-1]) + 1, (x, y, z), *size, turning))
    return found
