"""Smoothing: chosen candidates, rotations and weighted directions into a trajectory finer than a bin.

Rotations first, by Gauss-Newton on SO(3); then positions, which with rotations known is a linear least squares
problem but for the robust weights. Both are sparse and banded, so time is linear in frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from conformodal.poses import RelativeMotion

from .errors import ReasoningError
from .observations import Observations, PosePath
from .prior import MotionPrior

FloatArray = npt.NDArray[np.float64]

_ITERATIONS = 12
# Cauchy's scale in standard deviations: residuals beyond it lose their pull.
_CAUCHY = 2.0


def smooth(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """A path finer than candidates: orientations first, then positions; spreads stay those of the path given.

    Parameters
    ----------
    path
        Chosen poses of the frames of `seen`.
    seen
        Gives the relative motions.
    prior
        See :func:`smooth_positions`.
    """
    times, motions = seen.timestamps_s, seen.motions
    quats = smooth_orientations(path.orientations_quat_wxyz, path.orientation_spreads_rad, motions, times, prior)
    spreads = path.position_spreads
    positions = smooth_positions(path.positions_xyz, spreads, quats, motions, times, prior)
    return replace(path, positions_xyz=positions, orientations_quat_wxyz=quats)


def smooth_orientations(
    quats_wxyz: FloatArray,
    spreads_rad: FloatArray,
    motions: Sequence[RelativeMotion | None],
    timestamps_s: FloatArray,
    prior: MotionPrior,
) -> FloatArray:
    """Orientations (n, 4) wxyz that agree with the chosen ones and with the relative rotations.

    Parameters
    ----------
    quats_wxyz, spreads_rad
        (n, 4) and (n,): each frame's own answer and its spread.
    motions
        ``motions[t]`` leads from frame t - 1 to frame t.
    timestamps_s
        (n,) seconds; only used where a rotation is unknown.
    prior
        Turning rates to expect there.
    """
    n = len(quats_wxyz)
    if n < 2:
        return quats_wxyz.copy()
    own = Rotation.from_quat(quats_wxyz, scalar_first=True)
    relative = np.tile(np.eye(3), (n - 1, 1, 1))
    sigma = prior.turn_rate_rad_s * np.diff(timestamps_s)
    for t, motion in enumerate(motions[1:]):
        if motion is not None and motion.R_prev_next is not None:
            relative[t], sigma[t] = motion.R_prev_next, motion.rotation_sigma_rad
    link = Rotation.from_matrix(relative)
    now = own
    for _ in range(_ITERATIONS):
        r_own = (own.inv() * now).as_rotvec() / spreads_rad[:, None]
        between = now[:-1].inv() * now[1:]
        r_link = (link.inv() * between).as_rotvec() / sigma[:, None]
        w_own = _cauchy(np.linalg.norm(r_own, axis=1)) / spreads_rad**2
        w_link = _cauchy(np.linalg.norm(r_link, axis=1)) / sigma**2
        # moving frame t by d_t changes the link's residual by d_{t+1} - R(t, t+1)^T d_t
        turned = between.inv().as_matrix()
        eye = np.broadcast_to(np.eye(3), (n, 3, 3))
        diagonal = eye * w_own[:, None, None]
        diagonal = diagonal + np.pad(eye[1:] * w_link[:, None, None], ((1, 0), (0, 0), (0, 0)))
        diagonal = diagonal + np.pad(eye[1:] * w_link[:, None, None], ((0, 1), (0, 0), (0, 0)))
        gradient = r_own * (w_own * spreads_rad)[:, None]
        pull = r_link * (w_link * sigma)[:, None]
        gradient[1:] += pull
        gradient[:-1] -= np.einsum("tji,tj->ti", turned, pull)
        step = _solve_block_tridiagonal(diagonal, -turned * w_link[:, None, None], -gradient)
        now = now * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-8:
            break
    return np.asarray(now.as_quat(scalar_first=True))


def smooth_positions(
    positions_xyz: FloatArray,
    spreads: FloatArray,
    quats_wxyz: FloatArray,
    motions: Sequence[RelativeMotion | None],
    timestamps_s: FloatArray,
    prior: MotionPrior,
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
    now = positions_xyz.copy()
    for turn in range(_ITERATIONS):
        miss = (now - positions_xyz) / spreads
        w_own = _cauchy(np.linalg.norm(miss, axis=1) / np.sqrt(3))[:, None] / spreads**2
        bend = np.linalg.norm((second @ now), axis=1) * np.sqrt(w_smooth / 3)
        # at the start nothing is missed yet, so a wrong answer would pass for a sharp turn: hold bends stiff once
        w_bend = w_smooth * (_cauchy(bend / 2) if turn else 1.0)
        matrix = sparse.diags_array(w_own.ravel()) + bends.T @ sparse.diags_array(np.repeat(w_bend, 3)) @ bends
        if linked:
            move = np.diff(now, axis=0)[linked]
            length = np.linalg.norm(move, axis=1)
            # what a direction says across a step grows with the step, and a short step's length is mostly error
            sigma = np.maximum(angles * np.maximum(length, np.median(length)), 1e-9)
            off = np.linalg.norm(np.einsum("tij,tj->ti", across, move), axis=1) / sigma
            off = np.where(np.einsum("ti,ti->t", move, directions) < 0, np.inf, off)  # backwards: the pair misleads
            # a direction far off is no evidence at all (Geman and McClure): blur and near planes mislead a whole pair
            weight = np.where(np.isfinite(off), _cauchy(np.where(np.isfinite(off), off, 0)) ** 2, 0.0) / sigma**2
            blocks = sparse.block_diag(list(across * weight[:, None, None]), format="csr")
            matrix = matrix + differences.T @ blocks @ differences
        after = spsolve(matrix.tocsc(), (w_own * positions_xyz).ravel()).reshape(n, 3)
        change = np.abs(after - now).max()
        now = after
        if change < 1e-6:
            break
    return now


def _second_differences(dt: FloatArray) -> sparse.csr_array:
    """(n - 2, n): velocity after a frame minus velocity before it."""
    n = len(dt) + 1
    first = sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n)
    velocity = sparse.diags_array(1 / dt) @ first
    change = sparse.eye_array(n - 2, n - 1, k=1) - sparse.eye_array(n - 2, n - 1)
    return (change @ velocity).tocsr()


def _cauchy(residual: FloatArray) -> FloatArray:
    return np.asarray(1 / (1 + (residual / _CAUCHY) ** 2))


def _solve_block_tridiagonal(diagonal: FloatArray, above: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the symmetric system with blocks `diagonal` (n, 3, 3) and, from row t to t + 1, ``above[t]^T``."""
    n = len(diagonal)
    matrix = sparse.bsr_array((diagonal, np.arange(n), np.arange(n + 1)), shape=(3 * n, 3 * n))
    columns, pointers = np.arange(1, n), np.concatenate((np.arange(n), [n - 1]))
    upper = sparse.bsr_array((above.transpose(0, 2, 1), columns, pointers), shape=(3 * n, 3 * n))
    full = (matrix + upper + upper.T).tocsc()
    return np.asarray(spsolve(full, right.ravel()).reshape(n, 3))
