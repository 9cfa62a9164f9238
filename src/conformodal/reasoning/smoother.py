"""Smoothing: chosen candidates, relative motions and submaps into a trajectory finer than a bin.

Rotations first; then positions, which with rotations known is a linear least squares problem but for the robust
weights. Both are sparse and banded, so time is linear in frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from conformodal.poses import RelativeMotion, Submap

from .errors import ReasoningError
from .observations import Observations, PosePath
from .orientations import smooth_orientations
from .placing import Placing
from .prior import MotionPrior
from .robust import cauchy

FloatArray = npt.NDArray[np.float64]

_ITERATIONS = 12
# An answer missed by less than this share of the scene's depth is not doubted, however finely it claims to know: claims
# leave out what several finders and the given poses have in common.
_NEAR = 0.01


def smooth(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """A path finer than candidates: orientations first, then positions; spreads stay those of the path given.

    Parameters
    ----------
    path
        Chosen poses of the frames of `seen`.
    seen
        Gives the relative motions and submaps.
    prior
        See :func:`smooth_positions`.
    """
    times, motions, submaps = seen.timestamps_s, seen.motions, seen.submaps
    spreads = path.orientation_spreads_rad
    quats = smooth_orientations(path.orientations_quat_wxyz, spreads, motions, times, prior, submaps)
    positions = smooth_positions(path.positions_xyz, path.position_spreads, quats, motions, times, prior, submaps)
    return replace(path, positions_xyz=positions, orientations_quat_wxyz=quats)


def smooth_positions(
    positions_xyz: FloatArray,
    spreads: FloatArray,
    quats_wxyz: FloatArray,
    motions: Sequence[RelativeMotion | None],
    timestamps_s: FloatArray,
    prior: MotionPrior,
    submaps: Sequence[Submap] = (),
) -> FloatArray:
    """Positions (n, 3) in metres that agree with the chosen ones, the relative directions and the way the camera moves.

    Parameters
    ----------
    positions_xyz, spreads
        (n, 3) each frame's own answer and its spreads.
    quats_wxyz
        (n, 4) orientations, which turn relative directions into the world.
    motions, timestamps_s, prior
        As for :func:`smooth_orientations`; the prior's velocity changes bind three frames at a time.
    submaps
        Of these frames. Used where the prior knows what depths to expect, because a submap that may be of any length
        shrinks to nothing where networks err.
    """
    n = len(positions_xyz)
    if n < 3:
        return positions_xyz.copy()
    if not (spreads > 0).all():
        raise ReasoningError("spreads must be positive")
    dt = np.diff(timestamps_s)
    known = [(t, m) for t, m in enumerate(motions[1:]) if m is not None and m.direction_prev is not None]
    linked = [t for t, _ in known]
    rotation = Rotation.from_quat(quats_wxyz, scalar_first=True)
    directions = np.array([m.direction_prev for _, m in known]).reshape(-1, 3)
    directions = rotation[linked].apply(directions) if linked else directions
    angles = np.array([m.direction_sigma_rad for _, m in known])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]

    second = _second_differences(dt)
    step = (dt[1:] + dt[:-1]) / 2
    w_smooth = 1 / (prior.density_at(step) * step)
    first = (sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n)).tocsr()[linked]
    differences = sparse.kron(first, sparse.eye_array(3)).tocsr()
    bends = sparse.kron(second, sparse.eye_array(3)).tocsr()
    placing = Placing(submaps, quats_wxyz, prior) if submaps and np.isfinite(prior.depth_m) else None
    near = _NEAR * prior.depth_m if np.isfinite(prior.depth_m) else 0.0
    now = positions_xyz.copy()
    for turn in range(_ITERATIONS):
        miss = now - positions_xyz
        doubt = np.linalg.norm(miss / spreads, axis=1) * _beyond(np.linalg.norm(miss, axis=1), near)
        w_own = cauchy(doubt / np.sqrt(3))[:, None] / spreads**2
        bend = np.linalg.norm((second @ now), axis=1) * np.sqrt(w_smooth / 3)
        # at the start nothing is missed yet, so a wrong answer would pass for a sharp turn: hold bends stiff once
        w_bend = w_smooth * (cauchy(bend / 2) if turn else 1.0)
        matrix = sparse.diags_array(w_own.ravel()) + bends.T @ sparse.diags_array(np.repeat(w_bend, 3)) @ bends
        if linked:
            move = np.diff(now, axis=0)[linked]
            length = np.linalg.norm(move, axis=1)
            # what a direction says across a step grows with the step, and a short step's length is mostly error
            sigma = np.maximum(angles * np.maximum(length, np.median(length)), 1e-9)
            off = np.linalg.norm(np.einsum("tij,tj->ti", across, move), axis=1) / sigma
            off = np.where(np.einsum("ti,ti->t", move, directions) < 0, np.inf, off)  # backwards: the pair misleads
            # a direction far off is no evidence at all (Geman and McClure): blur and near planes mislead a whole pair
            weight = np.where(np.isfinite(off), cauchy(np.where(np.isfinite(off), off, 0)) ** 2, 0.0) / sigma**2
            blocks = sparse.block_diag(list(across * weight[:, None, None]), format="csr")
            matrix = matrix + differences.T @ blocks @ differences
        right = (w_own * positions_xyz).ravel()
        after = (spsolve(matrix.tocsc(), right) if placing is None else _placed(matrix, right, placing)).reshape(n, 3)
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


def _placed(matrix: sparse.csr_array, right: FloatArray, placing: Placing) -> FloatArray:
    """Solve for the positions and where the submaps lie, together."""
    weights, pulls = placing.prior()
    full = sparse.block_diag((matrix, sparse.diags_array(weights)))
    full = full + placing.rows.T @ sparse.diags_array(placing.weights) @ placing.rows
    solution = spsolve(full.tocsc(), np.concatenate((right, pulls)))
    placing.take(solution[len(right) :])
    return np.asarray(solution[: len(right)])
