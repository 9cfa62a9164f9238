"""The paper's reasoning, exactly: start from the most probable pose, then always the candidate nearest to what the
relative motion predicts from the pose chosen before (section 3). One wrong pick steers all later ones.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .observations import Observations, PosePath
from .prior import MotionPrior


def greedy(seen: Observations, prior: MotionPrior | None = None) -> PosePath:
    """Choose one candidate a frame.

    Orientation: the q that minimises ``|q - q_next|`` with ``q_next = quaternion(R_prev R_rel)``; q and -q count as
    one. Position: the p that minimises ``| t_rel - (p - p_prev) / |p - p_prev| |`` with t_rel turned into the world
    by the orientation chosen before. Where a motion is unknown, the most probable candidate is taken.

    Parameters
    ----------
    seen
        For the paper's result, with :func:`~conformodal.reasoning.interval_candidates`.
    prior
        Not used: the paper has none.
    """
    moves, turns = [0], [0]
    pairs = zip(seen.candidates, seen.candidates[1:], seen.motions[1:], strict=False)
    for before, here, motion in pairs:
        move = turn = 0
        if motion is not None and motion.R_prev_next is not None:
            rotation_prev = Rotation.from_quat(before.orientations_quat_wxyz[turns[-1]], scalar_first=True)
            q_next = (rotation_prev * Rotation.from_matrix(motion.R_prev_next)).as_quat(scalar_first=True)
            options = here.orientations_quat_wxyz
            signed = options * np.where(options @ q_next < 0, -1.0, 1.0)[:, None]
            turn = int(np.argmin(np.linalg.norm(signed - q_next, axis=1)))
            if motion.direction_prev is not None:
                t_rel = rotation_prev.apply(motion.direction_prev)
                step = here.positions_xyz - before.positions_xyz[moves[-1]]
                length = np.linalg.norm(step, axis=1, keepdims=True)
                heading = np.divide(step, length, out=np.zeros_like(step), where=length > 0)
                move = int(np.argmin(np.linalg.norm(t_rel - heading, axis=1)))
        moves.append(move)
        turns.append(turn)
    return PosePath.choose(seen.candidates, seen.timestamps_s, moves, turns)
