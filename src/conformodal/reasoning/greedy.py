"""The paper's reasoning, exactly: start from the most probable pose, then always the candidate nearest to what the
relative motion predicts from the pose chosen before (section 3). One wrong pick steers all later ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.poses import RelativeMotion

from .candidates import Candidates

FloatArray = npt.NDArray[np.float64]


def greedy(candidates: Sequence[Candidates], motions: Sequence[RelativeMotion | None]) -> tuple[FloatArray, FloatArray]:
    """Choose one candidate a frame.

    Orientation: the q that minimises ``|q - q_next|`` with ``q_next = quaternion(R_prev R_rel)``; q and -q count as
    one. Position: the p that minimises ``| t_rel - (p - p_prev) / |p - p_prev| |`` with t_rel turned into the world
    by the orientation chosen before. Where a motion is unknown, the most probable candidate is taken.

    Parameters
    ----------
    candidates
        One a frame; for the paper's result, made without splitting intervals.
    motions
        ``motions[t]`` leads from frame t - 1 to frame t; the first is ignored.

    Returns
    -------
    positions_xyz (n, 3), orientations_quat_wxyz (n, 4)
    """
    position, quat = candidates[0].most_probable
    positions, quats = [position], [quat]
    for here, motion in zip(candidates[1:], motions[1:], strict=True):
        p_prev, q_prev = positions[-1], quats[-1]
        position, quat = here.most_probable
        if motion is not None and motion.R_prev_next is not None:
            rotation_prev = Rotation.from_quat(q_prev, scalar_first=True)
            q_next = (rotation_prev * Rotation.from_matrix(motion.R_prev_next)).as_quat(scalar_first=True)
            options = here.orientations_quat_wxyz
            signed = options * np.where(options @ q_next < 0, -1.0, 1.0)[:, None]
            quat = options[np.argmin(np.linalg.norm(signed - q_next, axis=1))]
            if motion.direction_prev is not None:
                t_rel = rotation_prev.apply(motion.direction_prev)
                step = here.positions_xyz - p_prev
                length = np.linalg.norm(step, axis=1, keepdims=True)
                heading = np.divide(step, length, out=np.zeros_like(step), where=length > 0)
                position = here.positions_xyz[np.argmin(np.linalg.norm(t_rel - heading, axis=1))]
        positions.append(position)
        quats.append(quat)
    return np.array(positions), np.array(quats)
