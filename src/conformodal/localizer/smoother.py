"""Smoothing: chosen hypotheses, relative rotations and submaps into a trajectory finer than a bin.

Rotations first; then positions, which with rotations known is a linear least squares problem but for the robust
weights. Both are sparse and banded, so time is linear in frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Submap
from conformodal.geometry.robust import cauchy

from .errors import ReasoningError
from .observations import Observations, PosePath
from .orientations import smooth_orientations
from .prior import MotionPrior
from .settings import SMOOTHER
from .submap_alignment import SubmapAlignment


def smooth(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """A path finer than hypotheses, from chosen poses of the frames of `seen`, with their spreads.

    Orientations are smoothed first, then positions, with the relative motions and submaps of `seen`.
    """
    times, motions, submaps = seen.timestamps_s, seen.motions, seen.submaps
    spreads = path.orientation_spreads_rad
    quats = smooth_orientations(path.orientations_quat_wxyz, spreads, motions, times, prior, submaps)
    positions = smooth_positions(path.positions_xyz, path.position_spreads, quats, times, prior, submaps)
    return replace(path, positions_xyz=positions, orientations_quat_wxyz=quats)


def smooth_positions(
    positions_xyz: FloatArray,
    spreads: FloatArray,
    quats_wxyz: FloatArray,
    timestamps_s: FloatArray,
    prior: MotionPrior,
    submaps: Sequence[Submap] = (),
) -> FloatArray:
    """Positions (n, 3) in metres that agree with the chosen ones, their spreads (n, 3), and the way the camera moves.

    The prior's velocity changes bind three frames at a time. Orientations turn submaps into the world; these are used
    where the prior knows what depths to expect: a submap of free scale shrinks to nothing where positions err.
    """
    n = len(positions_xyz)
    if n < 3:
        return positions_xyz.copy()
    if not (spreads > 0).all():
        raise ReasoningError("spreads must be positive")
    dt = np.diff(timestamps_s)
    second = _second_differences(dt)
    step = (dt[1:] + dt[:-1]) / 2
    w_smooth = 1 / (prior.density_at(step) * step)
    bends = sparse.kron(second, sparse.eye_array(3)).tocsr()
    known_depth = bool(np.isfinite(prior.depth_m))
    alignment = SubmapAlignment(submaps, quats_wxyz, prior) if submaps and known_depth else None
    tolerated_m = SMOOTHER.tolerated * prior.depth_m if known_depth else 0.0
    now = positions_xyz.copy()
    for iteration in range(SMOOTHER.iterations):
        residual = now - positions_xyz
        counted = _beyond(np.linalg.norm(residual, axis=1), tolerated_m)
        standard = np.linalg.norm(residual / spreads, axis=1) * counted
        w_own = cauchy(standard / np.sqrt(3))[:, None] / spreads**2
        bend = np.linalg.norm((second @ now), axis=1) * np.sqrt(w_smooth / 3)
        # residuals are zero at the start, where an outlier looks like a sharp turn: the first iteration keeps all bends
        w_bend = w_smooth * (cauchy(bend / 2) if iteration else 1.0)
        matrix = sparse.diags_array(w_own.ravel()) + bends.T @ sparse.diags_array(np.repeat(w_bend, 3)) @ bends
        right = (w_own * positions_xyz).ravel()
        solved = spsolve(matrix.tocsc(), right) if alignment is None else _aligned(matrix, right, alignment)
        after = solved.reshape(n, 3)
        change = np.abs(after - now).max()
        now = after
        if change < 1e-6:
            break
    return now


def _beyond(off: FloatArray, near: float) -> FloatArray:
    """(n,) shares of distances that lie beyond `near`: 0 up to there, and 1 far away."""
    return np.sqrt(np.maximum(1 - (near / np.maximum(off, 1e-12)) ** 2, 0))


def _second_differences(dt: FloatArray) -> sparse.csr_array:
    """(n - 2, n): velocity after a frame minus velocity before it."""
    n = len(dt) + 1
    first = sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n)
    velocity = sparse.diags_array(1 / dt) @ first
    change = sparse.eye_array(n - 2, n - 1, k=1) - sparse.eye_array(n - 2, n - 1)
    return (change @ velocity).tocsr()


def _aligned(matrix: sparse.csr_array, right: FloatArray, alignment: SubmapAlignment) -> FloatArray:
    """Solve for the positions and the alignment of the submaps, together."""
    weights, pulls = alignment.prior()
    full = sparse.block_diag((matrix, sparse.diags_array(weights)))
    full = full + alignment.rows.T @ sparse.diags_array(alignment.weights) @ alignment.rows
    solution = spsolve(full.tocsc(), np.concatenate((right, pulls)))
    alignment.take(solution[len(right) :])
    return np.asarray(solution[: len(right)])
