"""Global reasoning: the sequence of candidates that is most probable as a whole (Viterbi 1967).

Position and orientation are searched together: where two places look alike, the image says which heading goes with
which place, so that a relative rotation that tells the headings apart tells the places apart. No mistake is final,
because every candidate of every frame stays in play until the end; a jump, as at a cut, costs a bounded price.

A vague candidate is near everything, so that a path could pass through it from one end of the scene to the other for
next to nothing. Its best path therefore goes on from where it can have come to, not from the candidate's mean
(per-survivor processing: Raheli, Polydoros and Tzou 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.poses import RelativeMotion, angle_between_quats

from .candidates import Candidates
from .observations import Observations, PosePath
from .prior import MotionPrior, rotation_sigma
from .settings import SEARCH


def best_step(score: FloatArray, log_transition: FloatArray, log_unary: FloatArray) -> tuple[FloatArray, IntArray]:
    """Scores (m,) of a frame's candidates by their best predecessors, and the indices (m,) of these.

    `score` (m_before,) and `log_transition` (m_before, m) are the frame before's; the best score is set to 0, so that
    long sequences do not run out of digits.
    """
    total = score[:, None] + log_transition
    origin = np.argmax(total, axis=0)
    after = total[origin, np.arange(len(log_unary))] + log_unary
    return after - after.max(), origin


def backtrack(backs: Sequence[IntArray], last: int) -> IntArray:
    """Indices of the sequence that ends in candidate `last`, one a frame."""
    chosen = np.empty(len(backs), dtype=np.int64)
    at = last
    for t in range(len(backs) - 1, -1, -1):
        chosen[t] = at
        at = int(backs[t][at])
    return chosen


def viterbi(seen: Observations, prior: MotionPrior) -> PosePath:
    """Choose one candidate a frame over a whole recording; `prior` says what speeds and turning rates to expect."""
    candidates = seen.candidates
    start, score = candidates[0], candidates[0].log_mass.astype(np.float64)
    backs: list[IntArray] = [np.zeros(len(score), dtype=np.int64)]
    for t, step_s in enumerate(np.diff(seen.timestamps_s), start=1):
        cost = transition_cost(start, candidates[t], seen.motions[t], step_s, prior)
        score, origin = best_step(score, -cost, candidates[t].log_mass)
        start = survivors(start, candidates[t], origin, cost, seen.motions[t], step_s, prior)
        backs.append(origin)
    return PosePath.choose(candidates, seen.timestamps_s, backtrack(backs, int(np.argmax(score))))


def transition_cost(
    before: Candidates, after: Candidates, motion: RelativeMotion | None, step_s: float, prior: MotionPrior
) -> FloatArray:
    """Cost in nats of every pair of poses, (m_before, m_after), bounded by the cost of a jump."""
    turn = orientation_cost(before, after, motion, step_s, prior)
    return np.asarray(np.minimum(turn + position_cost(before, after, step_s, prior), _jump_cost(motion)))


def _jump_cost(motion: RelativeMotion | None) -> float:
    """Cost in nats of a jump, see the settings of the search."""
    return SEARCH.jump if motion is None or not motion.reliable else SEARCH.followed_jump


def orientation_cost(
    before: Candidates, after: Candidates, motion: RelativeMotion | None, step_s: float, prior: MotionPrior
) -> FloatArray:
    """Cost in nats of every pair of orientations, (m_before, m_after).

    The angle from where the relative rotation leads; or, at a price, from where turning as usual could have led.
    """
    start = Rotation.from_quat(before.orientations_quat_wxyz, scalar_first=True)
    spread2 = before.orientation_spreads_rad[:, None] ** 2 + after.orientation_spreads_rad[None] ** 2

    def cost(predicted: Rotation, sigma: float) -> FloatArray:
        quats = np.atleast_2d(predicted.as_quat(scalar_first=True))
        angle = angle_between_quats(quats[:, None], after.orientations_quat_wxyz[None])
        return np.asarray(0.5 * angle**2 / (spread2 + sigma**2))

    total = cost(start, prior.turn_rate_rad_s * step_s)
    if motion is not None and motion.R_prev_next is not None:
        led = cost(start * Rotation.from_matrix(motion.R_prev_next), rotation_sigma(motion))
        total = np.minimum(led, total + SEARCH.rotation_outlier)
    return total


def position_cost(before: Candidates, after: Candidates, step_s: float, prior: MotionPrior) -> FloatArray:
    """Cost in nats of every pair of positions, (m_before, m_after).

    The distance of the step from the ball that the camera can have reached, in units of the candidates' spreads.
    Relative directions are left out: they changed no error by more than 3 % (benchmarks/ladder.py at source 9917639).
    """
    step = after.positions_xyz[None] - before.positions_xyz[:, None]
    reach = prior.reach_m(step_s)
    spread2 = before.position_spreads[:, None] ** 2 + after.position_spreads[None] ** 2  # (m, k, 3)
    length = np.linalg.norm(step, axis=2, keepdims=True)
    beyond = step * np.maximum(0, 1 - reach / np.maximum(length, 1e-9))
    total = 0.5 * np.sum(beyond**2 / spread2, axis=2)
    return np.asarray(total)


def survivors(
    start: Candidates,
    after: Candidates,
    origin: IntArray,
    cost: FloatArray,
    motion: RelativeMotion | None,
    step_s: float,
    prior: MotionPrior,
) -> Candidates:
    """The candidates of a frame, vague ones narrowed to where their best path can lead: starts of the next step.

    A candidate that is vaguer than where the path was and how far the camera can have moved or turned since has its
    position or orientation from these; all others, and those that a path jumped to, have their own.

    Parameters
    ----------
    start
        The frame before, as this function gave it.
    after
        The frame's candidates.
    origin
        (m,) the best predecessor of each.
    cost
        (m_before, m) from :func:`transition_cost`, of `start` and `after`.
    motion, step_s, prior
        As there.
    """
    linked = cost[origin, np.arange(len(origin))] < _jump_cost(motion)
    reach_m = prior.reach_m(step_s)
    came, spread = start.positions_xyz[origin], np.hypot(start.position_spreads[origin], reach_m)
    step = after.positions_xyz - came
    length = np.linalg.norm(step, axis=1, keepdims=True)
    led = came + step * np.minimum(1, reach_m / np.maximum(length, 1e-9))
    wider_position = linked & (np.sum(after.position_spreads**2, axis=1) > np.sum(spread**2, axis=1))

    facing = Rotation.from_quat(start.orientations_quat_wxyz[origin], scalar_first=True)
    if motion is not None and motion.R_prev_next is not None:
        turned, sigma = facing * Rotation.from_matrix(motion.R_prev_next), rotation_sigma(motion)
    else:
        sigma = prior.turn_rate_rad_s * step_s
        turn = (facing.inv() * Rotation.from_quat(after.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        turned = facing * Rotation.from_rotvec(turn * np.minimum(1, sigma / np.maximum(angle, 1e-9)))
    turn_spread = np.hypot(start.orientation_spreads_rad[origin], sigma)
    wider_rotation = linked & (after.orientation_spreads_rad > turn_spread)
    return replace(
        after,
        positions_xyz=np.where(wider_position[:, None], led, after.positions_xyz),
        position_spreads=np.where(wider_position[:, None], spread, after.position_spreads),
        orientations_quat_wxyz=np.where(
            wider_rotation[:, None], turned.as_quat(scalar_first=True), after.orientations_quat_wxyz
        ),
        orientation_spreads_rad=np.where(wider_rotation, turn_spread, after.orientation_spreads_rad),
    )
