"""Rotations as unit quaternions in ``wxyz`` order, camera poses along a path, and motions between them.

q and -q are one rotation. Where one sign is needed (bins over quaternion components), a reference quaternion fixes it,
so that one view has one label; distances use ``|dot|``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError

TARGET_NAMES = ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")  # of a pose: position, and quaternion
# Ground truth written with seven digits is orthonormal to about 1e-6; hand-made files are worse.
_ORTHONORMAL_TOLERANCE = 1e-3


class PoseError(ConformodalError):
    """An invalid pose, rotation or trajectory: NaN, not a rotation, different lengths."""


def check_rotation_matrices(matrices: FloatArray) -> FloatArray:
    """Check matrices (n, 3, 3) and project them to exact rotations."""
    if faults := rotation_faults(matrices):
        raise PoseError(f"pose {min(faults)}: {faults[min(faults)]}")
    u, _, vt = np.linalg.svd(matrices)
    return np.asarray(u @ vt)


def rotation_faults(matrices: FloatArray) -> dict[int, str]:
    """Why matrices (n, 3, 3) are not rotations, by index; valid ones are left out."""
    faults = {int(i): "holds NaN or infinity" for i in np.flatnonzero(~np.isfinite(matrices).all(axis=(1, 2)))}
    with np.errstate(over="ignore", invalid="ignore"):
        gap = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        far = ~(gap <= _ORTHONORMAL_TOLERANCE)
    for i in np.flatnonzero(far).tolist():
        faults.setdefault(i, f"not a rotation: R R^T differs from the identity by {gap[i]:.3g}")
    near = np.flatnonzero(~far)
    for i, det in zip(near.tolist(), np.linalg.det(matrices[near]).tolist(), strict=True):
        if det < 0:
            faults[i] = f"not a rotation: its determinant is {det:.3g}, a mirror image; expected 1"
    return faults


def rigid_motions(rotations: npt.ArrayLike, translations: npt.ArrayLike) -> FloatArray:
    """Matrices (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    shifts = np.asarray(translations, dtype=np.float64)
    motions = np.tile(np.eye(4), (*shifts.shape[:-1], 1, 1))
    motions[..., :3, :3], motions[..., :3, 3] = rotations, shifts
    return motions


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) whose product with a vector is the cross product of `vectors` (..., 3) with it."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=-1).reshape(*vectors.shape, 3)


def matrix_from_quat_wxyz(quats_wxyz: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4), normalised first."""
    try:
        return np.asarray(Rotation.from_quat(np.asarray(quats_wxyz, dtype=np.float64), scalar_first=True).as_matrix())
    except ValueError as exc:
        raise PoseError(f"quaternions are not rotations: {exc}") from exc


# SciPy checks matrices for five times as long as it converts them; from 1.17 on it can be told that they are rotations
_CAN_TRUST = "assume_valid" in signature(Rotation.from_matrix).parameters
_TRUSTED: dict[str, Any] = {"assume_valid": True} if _CAN_TRUST else {}


def trusted_rotation(matrices: FloatArray) -> Rotation:
    """Rotations of matrices (..., 3, 3) that are known to be rotations, but for rounding."""
    return Rotation.from_matrix(matrices, **_TRUSTED)


def normalise_quat(quats: npt.ArrayLike) -> FloatArray:
    """Quaternions (..., 4) at unit length."""
    arr = np.asarray(quats, dtype=np.float64)
    norm = np.linalg.norm(arr, axis=-1, keepdims=True)
    if not (np.isfinite(norm).all() and (norm > 1e-12).all()):
        raise PoseError("a quaternion of length zero (or not finite) has no direction")
    return np.asarray(arr / norm)


def angle_between_quats(a: npt.ArrayLike, b: npt.ArrayLike) -> FloatArray:
    """Angle in radians, [0, pi], between the rotations of quaternions (..., 4), whatever their signs or order."""
    qa, qb = normalise_quat(a), normalise_quat(b)
    # atan2 of half-chords keeps its digits near zero, where arccos of a dot product has none
    minus = np.linalg.norm(qa - qb, axis=-1)
    plus = np.linalg.norm(qa + qb, axis=-1)
    return np.asarray(4 * np.arctan2(np.minimum(minus, plus), np.maximum(minus, plus)))


def sign_reference(quats: npt.ArrayLike) -> FloatArray:
    """The quaternion (4,) whose hemisphere holds `quats` (n, 4) best: their principal axis, sign-free.

    Signs fixed along a sequence would not do: after a full turn the same view would get the opposite sign.
    """
    arr = normalise_quat(quats)
    _, vectors = np.linalg.eigh(arr.T @ arr)
    axis = vectors[:, -1]
    return np.asarray(axis * np.sign(axis[np.argmax(np.abs(axis))]))


def fix_sign(quats: npt.ArrayLike, reference: npt.ArrayLike) -> FloatArray:
    """`quats` (n, 4) with the sign that makes their dot product with `reference` (4,) non-negative."""
    arr = np.asarray(quats, dtype=np.float64)
    return np.where((arr @ np.asarray(reference))[:, None] < 0, -arr, arr)


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera-to-world pose."""

    position_xyz: FloatArray  # (3,) metres, the camera centre in the world
    orientation_quat_wxyz: FloatArray  # (4,) of unit length, rotating camera coordinates to world

    @property
    def pose_se3(self) -> FloatArray:
        """4x4 matrix ``T_world_cam``."""
        return rigid_motions(matrix_from_quat_wxyz(self.orientation_quat_wxyz), self.position_xyz)

    def at(self, timestamp_s: float) -> Trajectory:
        """The trajectory of this pose alone."""
        return Trajectory(np.array([timestamp_s]), self.position_xyz[None], self.orientation_quat_wxyz[None])


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera-to-world poses over time.

    Parameters
    ----------
    timestamps_s
        (n,) seconds.
    positions_xyz
        (n, 3) metres, the camera centre in the world.
    orientations_quat_wxyz
        (n, 4), rotating camera coordinates (x right, y down, z forward) to world; normalised here.

    Raises
    ------
    PoseError
        If shapes differ or a value is not finite.

    Examples
    --------
    >>> from conformodal import Trajectory
    >>> path = Trajectory([0.0, 0.1], [[0, 0, 0], [1, 0, 0]], [[1, 0, 0, 0], [2, 0, 0, 0]])
    >>> path.orientations_quat_wxyz[1]  # of unit length, w first
    array([1., 0., 0., 0.])
    >>> len(path[1:])
    1
    """

    timestamps_s: FloatArray
    positions_xyz: FloatArray
    orientations_quat_wxyz: FloatArray

    def __post_init__(self) -> None:
        times = np.asarray(self.timestamps_s, dtype=np.float64)
        if times.ndim != 1 or not np.isfinite(times).all():
            raise PoseError(f"timestamps_s must be finite and of shape (n,), got {times.shape}: {times.ravel()[:3]}")
        n = len(times)
        for name, width in (("positions_xyz", 3), ("orientations_quat_wxyz", 4)):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.shape != (n, width):
                raise PoseError(f"{name} must have shape ({n}, {width}) to fit the timestamps, got {array.shape}")
            if not np.isfinite(array).all():
                raise PoseError(f"{name} holds NaN or infinity in row {int(np.argwhere(~np.isfinite(array))[0][0])}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "timestamps_s", times)
        object.__setattr__(self, "orientations_quat_wxyz", normalise_quat(self.orientations_quat_wxyz))

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def __getitem__(self, index: slice | npt.NDArray[np.integer] | BoolArray) -> Trajectory:
        return Trajectory(self.timestamps_s[index], self.positions_xyz[index], self.orientations_quat_wxyz[index])

    @classmethod
    def from_poses_se3(cls, timestamps_s: npt.ArrayLike, poses_se3: npt.ArrayLike) -> Trajectory:
        """From 4x4 matrices ``T_world_cam`` (n, 4, 4)."""
        poses = np.asarray(poses_se3, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise PoseError(f"poses_se3 must have shape (n, 4, 4), got {poses.shape}")
        rotations = Rotation.from_matrix(check_rotation_matrices(poses[:, :3, :3]))
        return cls(np.asarray(timestamps_s), poses[:, :3, 3], rotations.as_quat(scalar_first=True))

    @property
    def poses_se3(self) -> FloatArray:
        """4x4 matrices ``T_world_cam``, (n, 4, 4)."""
        return rigid_motions(matrix_from_quat_wxyz(self.orientations_quat_wxyz), self.positions_xyz)


def concatenate(parts: Sequence[Trajectory]) -> Trajectory:
    """One trajectory from several, in order."""
    return Trajectory(
        np.concatenate([part.timestamps_s for part in parts]),
        np.concatenate([part.positions_xyz for part in parts]),
        np.concatenate([part.orientations_quat_wxyz for part in parts]),
    )


def pose_targets(poses: Trajectory, sign_reference: FloatArray) -> FloatArray:
    """Targets (n, 7) of poses: metres, then the quaternion with the sign that `sign_reference` (4,) gives it."""
    return np.column_stack((poses.positions_xyz, fix_sign(poses.orientations_quat_wxyz, sign_reference)))


class MotionStatus(StrEnum):
    """What a pair of frames allowed; everything but ``OK`` leaves the direction out."""

    OK = "ok"
    LOW_PARALLAX = "low_parallax"  # rotation sound, direction not: pure rotation, or far too small a step
    PLANE = "plane"  # all corners on one plane, which two motions explain; rotation with a wide spread
    REPEATED = "repeated"  # the same picture twice
    TOO_FEW = "too_few_corners"  # black, blank, blurred or covered
    LOST = "lost"  # a cut: the corners are not found again
    INCONSISTENT = "inconsistent"  # corners moved, but by no single motion


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Motion from a previous camera frame to the next one."""

    status: MotionStatus
    # (3, 3) takes directions from the next camera's frame to the previous one's, so that
    # ``R_world_next = R_world_prev @ R_prev_next``
    R_prev_next: FloatArray | None = None
    # (3,) unit vector from the previous camera centre to the next, in the previous camera's frame
    direction_prev: FloatArray | None = None
    n_tracks: int = 0  # corners followed
    n_inliers: int = 0  # of these, that agree with the motion
    rotation_sigma_rad: float = np.inf  # spread of the rotation's error about each axis
    direction_sigma_rad: float = np.inf  # spread of the direction's error

    @property
    def reliable(self) -> bool:
        """Whether at least the rotation can be trusted."""
        return self.R_prev_next is not None


@dataclass(frozen=True, eq=False)
class Submap:
    """Poses of a few frames relative to the first of them, its anchor, up to one unknown length: the submap's unit."""

    frames: IntArray  # (k,) increasing; the anchor first
    R_anchor_frame: FloatArray  # (k, 3, 3): takes directions from each camera's frame to the anchor's
    positions: FloatArray  # (k, 3) camera centres in the anchor's camera frame; the first is zero
    depth: float  # median depth of the corners, seen from the anchor
    sigma: float  # spread of the errors of `positions`, per axis
    rotation_sigma_rad: float  # spread of the errors of `R_anchor_frame`, about each axis

    @property
    def span(self) -> int:
        """Frames from the anchor to the last, those between that are not part of it counted in."""
        return int(self.frames[-1] - self.frames[0]) + 1


def table_of(poses: FloatArray) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of poses (n, 4, 4); NaN where a pose is NaN."""
    rows = np.full((len(poses), 7), np.nan)
    finite = np.isfinite(poses).all(axis=(1, 2))
    if finite.any():
        path = Trajectory.from_poses_se3(np.zeros(int(finite.sum())), poses[finite])
        rows[finite] = np.column_stack((path.positions_xyz, path.orientations_quat_wxyz))
    return rows


def matrices_of(rows: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of rows ``x y z qw qx qy qz`` (n, 7); NaN where a row is."""
    poses = np.full((len(rows), 4, 4), np.nan)
    finite = np.isfinite(rows).all(axis=1)
    path = Trajectory(np.zeros(int(finite.sum())), rows[finite, :3], rows[finite, 3:])
    poses[finite] = path.poses_se3 if len(path) else poses[finite]
    return poses
