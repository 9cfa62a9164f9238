"""How two recordings of a place overlap, and whether their poses are in the same world frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.core.words import counted
from conformodal.features.local import LocalFeatures
from conformodal.geometry import Trajectory, matrix_from_quat_wxyz, rigid_motions
from conformodal.io import Recording
from conformodal.io.joining import near_known
from conformodal.localizer.sources.keyframes import LandmarkMap
from conformodal.localizer.sources.mapping import build_map
from conformodal.tracking.flow import frame_features

from .measurement import PoseMeasurement
from .settings import OVERLAP


@dataclass(frozen=True)
class Overlap:
    """How a recording overlaps with a known one.

    Attributes
    ----------
    share_near
        Share of its poses within 0.3 m and 30 degrees of a known view.
    n_looked_at, n_localized
        Its images that were looked for in a map of the known recording, and those that were found.
    n_agree
        Localised images that agree on one rigid motion from its world frame to the known one.
    offset_m, offset_deg
        Of that motion, at the middle of its path; NaN where too few agree.
    moved
        Whether a rigid offset between the two world frames is likely: it is large beside the depth of the scene, and
        beside the scatter of the motions that agree.
    """

    share_near: float
    n_looked_at: int = 0
    n_localized: int = 0
    n_agree: int = 0
    offset_m: float = float("nan")
    offset_deg: float = float("nan")
    moved: bool = False

    def describe(self, known: str, new: str) -> str:
        """One line for people."""
        near = (
            f"{new}: {100 * self.share_near:.0f} % of its poses lie within {OVERLAP.near_m:g} m and "
            f"{OVERLAP.near_deg:g} degrees of a view of {known}"
        )
        found = f"{self.n_localized} of {counted(self.n_looked_at, 'image')} found in a map of it"
        if not np.isfinite(self.offset_m):
            return f"{near}; {found}, too few to compare the world frames"
        apart = f"{self.offset_m:.3f} m and {self.offset_deg:.1f} degrees apart"
        if self.moved:
            return f"{near}; {found}: the world frames are likely {apart}. Bring the poses into one frame"
        return f"{near}; {found}: the same world frame, {apart}"


def measure_overlap(known: Recording, new: Recording, depth_m: float) -> Overlap:
    """How `new` overlaps with `known`, of one camera; `depth_m` is the known scene's, or NaN.

    A map of landmarks from the known recording localises images of the other. World frames differ where their
    estimates differ from the given poses by one rigid motion.

    Raises
    ------
    PoseError
        If one of them has no poses.
    """
    views, poses = known.poses or known.require_truth(), new.poses or new.require_truth()
    if not np.isfinite(depth_m):
        return Overlap(_share_near(poses, views))
    mapped = evenly_spread(len(views), OVERLAP.keyframes)
    images, others = partial(_features, known), partial(_features, new)
    landmarks = build_map(images(known.posed[mapped]), views[mapped].poses_se3, known.camera, depth_m)
    return overlap_with(landmarks, views, new, others)


def overlap_with(
    landmarks: LandmarkMap, views: Trajectory, new: Recording, features: Callable[[IntArray], list[LocalFeatures]]
) -> Overlap:
    """As :func:`measure_overlap`, with a map of a recording and the poses of its frames.

    `features` are those of frames of `new`, with global descriptors like the map's.
    """
    poses, depth_m = new.poses or new.require_truth(), landmarks.depth_m
    near, asked = _share_near(poses, views), evenly_spread(len(poses), OVERLAP.images)
    found = [_best(landmarks.localize(image)) for image in features(new.posed[asked])]
    localized = [(one, i) for one, i in zip(found, asked.tolist(), strict=True) if one is not None]
    if len(localized) < OVERLAP.least:
        return Overlap(near, len(asked), len(localized))
    turns = matrix_from_quat_wxyz([one.orientation_quat_wxyz for one, _ in localized])
    estimates = rigid_motions(turns, [one.position_xyz for one, _ in localized])
    motions = estimates @ np.linalg.inv(poses.poses_se3[[i for _, i in localized]])
    return _common_motion(motions, poses.positions_xyz.mean(axis=0), near, len(asked), depth_m)


def _common_motion(motions: FloatArray, middle: FloatArray, near: float, n_asked: int, depth_m: float) -> Overlap:
    """The motion (4, 4) among m that most others agree with, at the middle of the path."""
    turns = Rotation.from_matrix(motions[:, :3, :3])
    places = motions[:, :3, :3] @ middle + motions[:, :3, 3]
    off_m = np.linalg.norm(places[:, None] - places[None], axis=2)
    off_rad = np.array([(turns * turn.inv()).magnitude() for turn in turns])
    agree = (off_m < OVERLAP.agree_depths * depth_m) & (off_rad < np.radians(OVERLAP.agree_deg))
    its = agree[np.argmax(agree.sum(axis=1))]
    n = int(its.sum())
    if n < max(OVERLAP.least, len(motions) / 2):
        return Overlap(near, n_asked, len(motions), n)
    place, turn = np.median(places[its], axis=0), turns[its].mean()
    offset_m, offset_deg = float(np.linalg.norm(place - middle)), float(np.degrees(turn.magnitude()))
    scatter_m = np.median(np.linalg.norm(places[its] - place, axis=1))
    scatter_deg = np.degrees(np.median((turns[its] * turn.inv()).magnitude()))
    moved = offset_m > max(OVERLAP.offset_depths * depth_m, scatter_m)
    moved |= offset_deg > max(OVERLAP.offset_deg, scatter_deg)
    return Overlap(near, n_asked, len(motions), n, offset_m, offset_deg, bool(moved))


def _share_near(poses: Trajectory, views: Trajectory) -> float:
    return float(near_known(poses, views, OVERLAP.near_m, np.radians(OVERLAP.near_deg)).mean())


def _best(estimates: list[PoseMeasurement]) -> PoseMeasurement | None:
    sure = [one for one in estimates if one.n_inliers >= OVERLAP.inliers]
    return max(sure, key=lambda one: one.n_inliers, default=None)


def _features(sequence: Recording, frames: IntArray) -> list[LocalFeatures]:
    return in_threads(partial(frame_features, sequence), frames.tolist())
