"""Smoothing: chosen hypotheses, relative rotations and submaps into a trajectory finer than a bin.

Orientations first, by Gauss-Newton on SO(3); then positions, which with orientations known is a linear least squares
problem but for the robust weights. Both are sparse and banded, so time is linear in frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import RelativeMotion, Submap, matrix_from_quat_wxyz
from conformodal.geometry.adjustment import cauchy

from .observations import MotionPrior, Observations, PosePath, rotation_sigma, same_place

_UNKNOWNS = 7  # of a submap's alignment with the world: start (3), scale, rotation (3)
_ITERATIONS = 12  # at most, of each problem
# share of the scene's depth. A smaller residual of a position is never down-weighted, however small its standard
# deviation: errors that all sources and the given poses have in common are not part of it
_TOLERATED = 0.01
_SUBMAP_ORIENTATION_SIGMA_RAD = float(np.radians(10.0))  # standard deviation of the orientation of a whole submap
_SUBMAP_SCALE_RESET = 5.0  # a submap whose scale leaves the expected one by more than this factor starts again there
# Share of the standard deviations of images that show a known place with which they go in: these are those of the tail
# of the errors, and the loss is robust. Chosen on fr1 and redkitchen, seeds 0 and 20: at 1, the prior of the motion
# smoothed paths of fast turns away from good estimates; smaller ones follow the errors that neighbouring images share
_CORE_OF_SPREAD = 0.6
# least spreads, as a share of the depth and in radians, with which an image that shows no known place goes in
_UNKNOWN_SPREAD, _UNKNOWN_SPREAD_RAD = 0.2, 0.5


def image_hypotheses(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """The hypotheses of single images that a path of :func:`choose_places` stands for, with spreads of the images.

    This is what a smoother starts from: it weighs in the neighbours in time itself. An image that shows no known place
    says little of its pose, and gets wide spreads.
    """
    positions, spreads = path.positions_xyz.copy(), path.position_spreads.copy()
    quats, turns = path.orientations_quat_wxyz.copy(), path.orientation_spreads_rad.copy()
    for t, hypotheses in enumerate(seen.candidates):
        rows = np.flatnonzero(same_place(hypotheses, positions[t], quats[t], prior))
        if rows.size:
            off2 = ((hypotheses.positions_xyz[rows] - positions[t]) ** 2).sum(axis=1)
            wide2 = (hypotheses.position_spreads[rows] ** 2).sum(axis=1) + (spreads[t] ** 2).sum()
            best = rows[np.argmax(hypotheses.log_weights[rows] - 0.5 * off2 / wide2)]
            positions[t], spreads[t] = hypotheses.positions_xyz[best], hypotheses.position_spreads[best]
            spreads[t] *= _CORE_OF_SPREAD
            quats[t] = hypotheses.orientations_quat_wxyz[best]
            turns[t] = _CORE_OF_SPREAD * hypotheses.orientation_spreads_rad[best]
    unknown = ~seen.is_known
    spreads[unknown] = np.maximum(spreads[unknown], _UNKNOWN_SPREAD * prior.scale_m)
    turns[unknown] = np.maximum(turns[unknown], _UNKNOWN_SPREAD_RAD)
    return PosePath(path.timestamps_s, positions, spreads, quats, turns)


def smooth(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """A path finer than hypotheses, from chosen poses of the frames of `seen`, with their spreads.

    Orientations are smoothed first, then positions, with the relative motions and submaps of `seen`.
    """
    times, motions, submaps = seen.timestamps_s, seen.motions, seen.submaps
    spreads = path.orientation_spreads_rad
    quats = smooth_orientations(path.orientations_quat_wxyz, spreads, motions, times, prior, submaps)
    positions = smooth_positions(path.positions_xyz, path.position_spreads, quats, times, prior, submaps)
    return replace(path, positions_xyz=positions, orientations_quat_wxyz=quats)


def smooth_orientations(
    quats_wxyz: FloatArray,
    spreads_rad: FloatArray,
    motions: Sequence[RelativeMotion | None],
    timestamps_s: FloatArray,
    prior: MotionPrior,
    submaps: Sequence[Submap] = (),
) -> FloatArray:
    """Orientations (n, 4) wxyz that agree with the chosen ones, their spreads (n,), and the relative rotations.

    ``motions[t]`` leads from frame t - 1 to frame t. Where its rotation is unknown, times (n,) and the prior tell how
    far the camera may have turned. Submaps have rotations over more than one step.
    """
    n = len(quats_wxyz)
    if n < 2:
        return quats_wxyz.copy()
    chosen = Rotation.from_quat(quats_wxyz, scalar_first=True)
    start, end, relative, sigma = _links(motions, prior.turn_rate_rad_s * np.diff(timestamps_s), submaps)
    link, n_links = Rotation.from_matrix(relative), len(start)
    finite_sigma = np.where(np.isfinite(sigma), sigma, 0.0)  # the others weigh nothing
    rows = np.arange(n_links + 1)
    ends = sparse.bsr_array((np.tile(np.eye(3), (n_links, 1, 1)), end, rows), shape=(3 * n_links, 3 * n))
    now = chosen
    for _ in range(_ITERATIONS):
        r_chosen = (chosen.inv() * now).as_rotvec() / spreads_rad[:, None]
        between = now[start].inv() * now[end]
        r_link = (link.inv() * between).as_rotvec() / sigma[:, None]
        w_chosen = cauchy(np.linalg.norm(r_chosen, axis=1)) / spreads_rad**2
        w_link = cauchy(np.linalg.norm(r_link, axis=1)) / sigma**2
        # moving a link's start by d_s and its end by d_e changes its residual by d_e - R(start, end)^T d_s
        starts = sparse.bsr_array((between.inv().as_matrix(), start, rows), shape=ends.shape)
        by_step = (ends - starts).tocsr()
        weighted = by_step.T @ sparse.diags_array(np.repeat(w_link, 3))
        gradient = (r_chosen * (w_chosen * spreads_rad)[:, None]).ravel()
        gradient = gradient + weighted @ (r_link * finite_sigma[:, None]).ravel()
        system = weighted @ by_step + sparse.diags_array(np.repeat(w_chosen, 3))
        step = -spsolve(system.tocsc(), gradient).reshape(n, 3)
        now = now * Rotation.from_rotvec(step)
        if np.abs(step).max() < 1e-8:
            break
    return np.asarray(now.as_quat(scalar_first=True))


def _links(
    motions: Sequence[RelativeMotion | None], unknown_rad: FloatArray, submaps: Sequence[Submap]
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Frames that links lead from and to (m,), rotations (m, 3, 3) and their spreads (m,)."""
    steps = np.arange(len(unknown_rad))
    relative, sigma = np.tile(np.eye(3), (len(steps), 1, 1)), unknown_rad.copy()
    for t, motion in enumerate(motions[1:]):
        if motion is not None and motion.R_prev_next is not None:
            relative[t], sigma[t] = motion.R_prev_next, rotation_sigma(motion)
    return (
        np.concatenate((steps, *(np.full(len(s.frames) - 1, s.frames[0]) for s in submaps))),
        np.concatenate((steps + 1, *(s.frames[1:] for s in submaps))),
        np.concatenate((relative, *(s.R_anchor_frame[1:] for s in submaps))),
        np.concatenate((sigma, *(np.full(len(s.frames) - 1, s.rotation_sigma_rad) for s in submaps))),
    )


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
    # the system is stiff: far from the origin of the world, rounding would move the path
    origin = positions_xyz.mean(axis=0)
    positions_xyz = positions_xyz - origin
    dt = np.diff(timestamps_s)
    second = _second_differences(dt)
    step = (dt[1:] + dt[:-1]) / 2
    w_smooth = 1 / (prior.density_at(step) * step)
    bends = sparse.kron(second, sparse.eye_array(3)).tocsr()
    depth_is_finite = bool(np.isfinite(prior.depth_m))
    alignment = _SubmapAlignment(submaps, quats_wxyz, prior) if submaps and depth_is_finite else None
    tolerated_m = _TOLERATED * prior.depth_m if depth_is_finite else 0.0
    now = positions_xyz.copy()
    for iteration in range(_ITERATIONS):
        residual = now - positions_xyz
        counted = _share_beyond(np.linalg.norm(residual, axis=1), tolerated_m)
        standard = np.linalg.norm(residual / spreads, axis=1) * counted
        w_chosen = cauchy(standard / np.sqrt(3))[:, None] / spreads**2
        bend = np.linalg.norm((second @ now), axis=1) * np.sqrt(w_smooth / 3)
        # residuals are zero at the start, where an outlier looks like a sharp turn: the first iteration keeps all bends
        w_bend = w_smooth * (cauchy(bend / 2) if iteration else 1.0)
        matrix = sparse.diags_array(w_chosen.ravel()) + bends.T @ sparse.diags_array(np.repeat(w_bend, 3)) @ bends
        right = (w_chosen * positions_xyz).ravel()
        solved = spsolve(matrix.tocsc(), right) if alignment is None else alignment.solve(matrix, right)
        after = solved.reshape(n, 3)
        change = np.abs(after - now).max()
        now = after
        if change < 1e-6:
            break
    return np.asarray(now + origin)


def _share_beyond(off: FloatArray, near: float) -> FloatArray:
    """(n,) shares of distances that lie beyond `near`: 0 up to there, and 1 far away."""
    return np.sqrt(np.maximum(1 - (near / np.maximum(off, 1e-12)) ** 2, 0))


def _second_differences(dt: FloatArray) -> sparse.csr_array:
    """(n - 2, n): velocity after a frame minus velocity before it."""
    n = len(dt) + 1
    first = sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n)
    velocity = sparse.diags_array(1 / dt) @ first
    change = sparse.eye_array(n - 2, n - 1, k=1) - sparse.eye_array(n - 2, n - 1)
    return (change @ velocity).tocsr()


class _SubmapAlignment:
    """Submaps of n frames with orientations (n, 4), each aligned with the world by its start, scale and rotation.

    A submap is a piece of the path in a frame of its own; the prior gives the depths to expect, and so its scale. With
    orientations known, all unknowns are linear.
    """

    def __init__(self, submaps: Sequence[Submap], quats_wxyz: FloatArray, prior: MotionPrior) -> None:
        self._expected = prior.depth_m / np.array([s.depth for s in submaps])
        # errors of consecutive positions are correlated: all together say little more of the scale than one of them
        spread = prior.depth_spread / np.sqrt([s.span for s in submaps])
        self._spread, self._scale = spread, self._expected.copy()
        blocks, variances = [], []
        for submap, unit in zip(submaps, self._expected, strict=True):
            path = submap.positions @ matrix_from_quat_wxyz(quats_wxyz[submap.frames[:1]])[0].T
            start = np.broadcast_to(-np.eye(3), (len(path), 3, 3))
            # a rotation by w about the anchor moves a point v by w x v = -[v]x w
            cross = np.cross(np.eye(3), unit * path[:, None])
            blocks.append(np.concatenate((start, -path[:, :, None], cross), axis=2).reshape(-1, _UNKNOWNS))
            variances.append(np.full(path.size, (submap.sigma * unit) ** 2))
        frames = np.concatenate([s.frames for s in submaps])
        columns = (3 * frames[:, None] + np.arange(3)).ravel()
        shape = (len(columns), 3 * len(quats_wxyz))
        here = sparse.csr_array((np.ones(len(columns)), (np.arange(len(columns)), columns)), shape=shape)
        # (m, 3 n + 7 submaps): position minus the submap's position, metres; and (m,) one over the variances
        self._rows = sparse.csr_array(sparse.hstack([here, sparse.block_diag(blocks)]))
        self._weights = 1 / np.concatenate(variances)
        self._rotation_weight = np.array([s.span for s in submaps]) / _SUBMAP_ORIENTATION_SIGMA_RAD**2

    def solve(self, matrix: sparse.csr_array, right: FloatArray) -> FloatArray:
        """Solve for the positions and the alignment together; the next solution is linearised about this one."""
        weights, pulls = self._prior()
        full = sparse.block_diag((matrix, sparse.diags_array(weights)))
        full = full + self._rows.T @ sparse.diags_array(self._weights) @ self._rows
        solution = spsolve(full.tocsc(), np.concatenate((right, pulls)))
        self._scale = solution[len(right) :].reshape(-1, _UNKNOWNS)[:, 3]
        return np.asarray(solution[: len(right)])

    def _prior(self) -> tuple[FloatArray, FloatArray]:
        """Prior weights (7 submaps,) of the unknowns, and weights times expected values."""
        # normal in the logarithm of the scale, linearised about the scale so far
        scale, expected = self._scale, self._expected
        lost = ~((scale > expected / _SUBMAP_SCALE_RESET) & (scale < expected * _SUBMAP_SCALE_RESET))
        around = np.where(lost, expected, scale)
        weight = 1 / (self._spread * around) ** 2
        value = around * (1 - np.log(around / expected))
        weights, pulls = np.zeros((2, len(scale), _UNKNOWNS))
        weights[:, :3] = 1e-9  # keeps the system regular
        weights[:, 3], pulls[:, 3] = weight, weight * value
        weights[:, 4:] = self._rotation_weight[:, None]
        return weights.ravel(), pulls.ravel()
