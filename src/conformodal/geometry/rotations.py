"""Rotations as unit quaternions in ``wxyz`` order, on top of SciPy.

q and -q are one rotation. Where one sign is needed (bins over quaternion components), a reference quaternion fixes it,
so that one view has one label; distances use ``|dot|``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError

# Ground truth written with seven digits is orthonormal to about 1e-6; hand-made files are worse.
_ORTHONORMAL_TOLERANCE = 1e-3


class PoseError(ConformodalError):
    """An invalid pose, rotation or trajectory: NaN, not a rotation, different lengths."""


def check_rotation_matrices(matrices: npt.ArrayLike, name: str = "rotation") -> FloatArray:
    """Check matrices (n, 3, 3) and project them to exact rotations."""
    arr = np.asarray(matrices, dtype=np.float64)
    if arr.ndim != 3 or arr.shape[1:] != (3, 3):
        raise PoseError(f"{name} must have shape (n, 3, 3), got {arr.shape}")
    faults = rotation_faults(arr)
    if faults:
        i = min(faults)
        raise PoseError(f"{name} {i} {'is ' if faults[i].startswith('not') else ''}{faults[i]}")
    u, _, vt = np.linalg.svd(arr)
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


def quat_wxyz_from_matrix(matrices: npt.ArrayLike) -> FloatArray:
    """Unit quaternions (n, 4) of rotation matrices (n, 3, 3); the sign is SciPy's choice."""
    return np.asarray(Rotation.from_matrix(np.asarray(matrices, dtype=np.float64)).as_quat(scalar_first=True))


def matrix_from_quat_wxyz(quats_wxyz: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4), normalised first."""
    try:
        return np.asarray(Rotation.from_quat(np.asarray(quats_wxyz, dtype=np.float64), scalar_first=True).as_matrix())
    except ValueError as exc:
        raise PoseError(f"quaternions are not rotations: {exc}") from exc


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
