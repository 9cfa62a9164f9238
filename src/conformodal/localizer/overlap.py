"""Whether the poses of two recordings of a place are in the same world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.core.words import counted
from conformodal.features.local import ORB
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.tracking.motions import frame_features

from .sources.landmark_map import LandmarkMap

_NEAR_M, _NEAR_DEG = 0.3, 30.0
_KEYFRAMES, _IMAGES = 150, 40  # of the known recording, that are mapped; of the other, that are localised
_INLIERS = 25  # distinct, that an estimate needs
_MIN_IMAGES = 8  # images that must agree
_AGREE_DEPTHS, _AGREE_DEG = 0.1, 5.0  # within which motions agree
# world frames differ by more than this, and by more than half of the motions that agree differ from their median
_OFFSET_DEPTHS, _OFFSET_DEG = 0.05, 3.0


@dataclass(frozen=True)
class Overlap:
    """How a recording overlaps with a reference recording."""

    share_near: float  # of its poses within 0.3 m and 30 degrees of a view of the reference
    n_queried: int = 0  # of its images, that were looked for in a map of the reference
    n_localized: int = 0  # of these, that were localised
    n_agree: int = 0  # of these, that agree on one rigid motion from its world frame to that of the reference
    offset_m: float = float("nan")  # of that motion, at the middle of its path; NaN where too few agree
    offset_deg: float = float("nan")
    # whether a rigid offset between the two world frames is likely: it is large beside the depth of the scene, and
    # beside the scatter of the motions that agree
    frames_differ: bool = False

    def describe(self, reference: str, other: str) -> str:
        """One line for people."""
        near = (
            f"{other}: {100 * self.share_near:.0f} % of its poses lie within {_NEAR_M:g} m and "
            f"{_NEAR_DEG:g} degrees of a view of {reference}"
        )
        localized = f"{self.n_localized} of {counted(self.n_queried, 'image')} found in a map of it"
        if not np.isfinite(self.offset_m):
            return f"{near}; {localized}, too few to compare the world frames"
        apart = f"{self.offset_m:.3f} m and {self.offset_deg:.1f} degrees apart"
        if self.frames_differ:
            return f"{near}; {localized}: the world frames are likely {apart}. Bring the poses into one frame"
        return f"{near}; {localized}: the same world frame, {apart}"


def measure_overlap(reference: Recording, other: Recording, depth_m: float) -> Overlap:
    """How `other` overlaps with `reference`, of one camera; `depth_m` is the reference scene's, or NaN.

    A map of landmarks from the reference localises images of the other. World frames differ where their estimates
    differ from the given poses by one rigid motion.
    """
    views, poses = reference.poses or reference.require_truth(), other.poses or other.require_truth()
    near = float(near_known(poses, views, _NEAR_M, np.radians(_NEAR_DEG)).mean())
    if not np.isfinite(depth_m):
        return Overlap(near)
    mapped, queried = evenly_spread(len(views), _KEYFRAMES), evenly_spread(len(poses), _IMAGES)
    keyframes = in_threads(partial(frame_features, reference, detector=ORB), reference.posed[mapped].tolist())
    queries = in_threads(partial(frame_features, other, detector=ORB), other.posed[queried].tolist())
    landmarks = LandmarkMap.build(keyframes, views[mapped].poses_se3, reference.camera, depth_m)
    motions = []
    for query, frame in zip(queries, queried.tolist(), strict=True):
        sure = [one for one in landmarks.localize(query) if one.n_inliers >= _INLIERS]
        if sure:
            best = max(sure, key=lambda one: one.n_inliers)
            estimate = best.pose_se3
            motions.append(estimate @ np.linalg.inv(poses.poses_se3[frame]))
    middle = poses.positions_xyz.mean(axis=0)
    return compare_world_frames(np.array(motions), middle, depth_m, Overlap(near, len(queried), len(motions)))


def compare_world_frames(motions: FloatArray, middle: FloatArray, depth_m: float, overlap: Overlap) -> Overlap:
    """`overlap` with the motion (4, 4) among m that most others agree with, at the middle of the path."""
    if len(motions) < _MIN_IMAGES:
        return overlap
    turns = Rotation.from_matrix(motions[:, :3, :3])
    places = motions[:, :3, :3] @ middle + motions[:, :3, 3]
    off_m = np.linalg.norm(places[:, None] - places[None], axis=2)
    off_rad = np.array([(turns * turn.inv()).magnitude() for turn in turns])
    agree = (off_m < _AGREE_DEPTHS * depth_m) & (off_rad < np.radians(_AGREE_DEG))
    largest = agree[np.argmax(agree.sum(axis=1))]
    n = int(largest.sum())
    if n < max(_MIN_IMAGES, len(motions) / 2):
        return replace(overlap, n_agree=n)
    place, turn = np.median(places[largest], axis=0), turns[largest].mean()
    offset_m, offset_deg = float(np.linalg.norm(place - middle)), float(np.degrees(turn.magnitude()))
    scatter_m = np.median(np.linalg.norm(places[largest] - place, axis=1))
    scatter_deg = np.degrees(np.median((turns[largest] * turn.inv()).magnitude()))
    far = offset_m > max(_OFFSET_DEPTHS * depth_m, scatter_m)
    turned = offset_deg > max(_OFFSET_DEG, scatter_deg)
    return replace(overlap, n_agree=n, offset_m=offset_m, offset_deg=offset_deg, frames_differ=bool(far or turned))


def near_known(poses: Trajectory, known: Trajectory, most_m: float, most_rad: float) -> BoolArray:
    """(n,) whether each of n poses has a known pose within a distance and an angle."""
    near = [
        (np.linalg.norm(known.positions_xyz - position, axis=1) <= most_m)
        & (np.abs(known.orientations_quat_wxyz @ quat) >= np.cos(most_rad / 2))
        for position, quat in zip(poses.positions_xyz, poses.orientations_quat_wxyz, strict=True)
    ]
    return np.array([rows.any() for rows in near], dtype=bool)
