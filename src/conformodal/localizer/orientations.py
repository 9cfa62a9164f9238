"""Smoothing of orientations: chosen candidates, relative rotations and submaps, by Gauss-Newton on SO(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import RelativeMotion, Submap
from conformodal.geometry.robust import cauchy

from .prior import MotionPrior, rotation_sigma
from .settings import SMOOTHER


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
    own = Rotation.from_quat(quats_wxyz, scalar_first=True)
    start, end, relative, sigma = _links(motions, prior.turn_rate_rad_s * np.diff(timestamps_s), submaps)
    link, n_links = Rotation.from_matrix(relative), len(start)
    known = np.where(np.isfinite(sigma), sigma, 0.0)  # the others weigh nothing
    rows = np.arange(n_links + 1)
    ends = sparse.bsr_array((np.tile(np.eye(3), (n_links, 1, 1)), end, rows), shape=(3 * n_links, 3 * n))
    now = own
    for _ in range(SMOOTHER.iterations):
        r_own = (own.inv() * now).as_rotvec() / spreads_rad[:, None]
        between = now[start].inv() * now[end]
        r_link = (link.inv() * between).as_rotvec() / sigma[:, None]
        w_own = cauchy(np.linalg.norm(r_own, axis=1)) / spreads_rad**2
        w_link = cauchy(np.linalg.norm(r_link, axis=1)) / sigma**2
        # moving a link's start by d_s and its end by d_e changes its residual by d_e - R(start, end)^T d_s
        starts = sparse.bsr_array((between.inv().as_matrix(), start, rows), shape=ends.shape)
        by_step = (ends - starts).tocsr()
        weighted = by_step.T @ sparse.diags_array(np.repeat(w_link, 3))
        gradient = (r_own * (w_own * spreads_rad)[:, None]).ravel() + weighted @ (r_link * known[:, None]).ravel()
        system = weighted @ by_step + sparse.diags_array(np.repeat(w_own, 3))
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
