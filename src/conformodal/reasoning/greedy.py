"""The paper's reasoning (section 3): start from the most probable pose, then always take the combination of intervals
that is nearest to what the relative motion predicts from the pose chosen before. One wrong pick steers all later ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.conformal import Regions
from conformodal.poses import RelativeMotion

from .candidates import interval_pieces
from .errors import ReasoningError
from .observations import PosePath

FloatArray = npt.NDArray[np.float64]

_LEAST_NORM = 1e-6


@dataclass(frozen=True, eq=False)
class IntervalMeans:
    """The intervals of one frame's region, each at its mean. Combinations of one a target are the paper's candidates.

    Attributes
    ----------
    means, spreads, log_mass
        Seven arrays (m_j,) each, of x, y, z and the quaternion wxyz: means, standard deviations within the interval,
        and the logarithm of its softmax mass.
    """

    means: list[FloatArray]
    spreads: list[FloatArray]
    log_mass: list[FloatArray]


def interval_means(proba: Sequence[npt.NDArray[np.floating[Any]]], regions: Regions) -> list[IntervalMeans]:
    """Intervals of every frame's region. Where a target's set is empty, its most probable bin stands in.

    Parameters
    ----------
    proba
        Seven arrays (n, K_j): x, y, z and the quaternion wxyz.
    regions
        Of the same n frames.
    """
    found = []
    for pieces in interval_pieces(proba, regions):
        found.append(IntervalMeans([p.mean for p in pieces], [p.spread for p in pieces], [p.log_mass for p in pieces]))
    return found


def greedy(
    intervals: Sequence[IntervalMeans], motions: Sequence[RelativeMotion | None], timestamps_s: npt.ArrayLike
) -> PosePath:
    """Choose one combination of intervals a frame, among all of them.

    Orientation: the q that minimises ``|q - q_next|`` with ``q_next = quaternion(R_prev R_rel)``; q and -q count as
    one. The square of that distance is a sum over components, so each is minimised by itself. Position: the p that
    minimises ``| t_rel - (p - p_prev) / |p - p_prev| |`` with t_rel turned into the world by the orientation chosen
    before. Where a motion is unknown, the most probable combination is taken.

    Parameters
    ----------
    intervals
        Of n frames of one recording.
    motions
        ``motions[t]`` leads from frame t - 1 to frame t; the first is ignored.
    timestamps_s
        (n,) seconds.

    Raises
    ------
    ReasoningError
        If there are no frames, or lengths differ.
    """
    times = np.asarray(timestamps_s, dtype=np.float64)
    if not 0 < len(intervals) == len(motions) == len(times):
        raise ReasoningError(
            f"greedy needs as many frames as motions and timestamps, at least one: got {len(intervals)} frames, "
            f"{len(motions)} motions, {len(times)} timestamps"
        )
    chosen: list[list[int]] = []
    place, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    places, quats = [], []
    for t, (here, motion) in enumerate(zip(intervals, motions, strict=True)):
        best = [int(np.argmax(mass)) for mass in here.log_mass]
        if t and motion is not None and motion.R_prev_next is not None:
            rotation_prev = Rotation.from_quat(quat, scalar_first=True)
            q_next = (rotation_prev * Rotation.from_matrix(motion.R_prev_next)).as_quat(scalar_first=True)
            best[3:] = _nearest_quat(here.means[3:], q_next)
            if motion.direction_prev is not None:
                best[:3] = _along(here.means[:3], place, rotation_prev.apply(motion.direction_prev))
        place = np.array([here.means[j][best[j]] for j in range(3)])
        raw = np.array([here.means[j][best[j]] for j in range(3, 7)])
        norm = float(np.linalg.norm(raw))
        quat = raw / norm if norm > _LEAST_NORM else quat  # components that cancel say nothing
        chosen.append(best)
        places.append(place)
        quats.append(quat)
    spreads = np.array(
        [[its.spreads[j][best[j]] for j in range(7)] for its, best in zip(intervals, chosen, strict=True)]
    )
    turns = 2 * np.sqrt(np.mean(spreads[:, 3:] ** 2, axis=1))  # a quaternion moves half as far as the rotation turns
    return PosePath(times, np.array(places), spreads[:, :3], np.array(quats), turns)


def _nearest_quat(means: Sequence[FloatArray], q_next: FloatArray) -> list[int]:
    """The combination nearest to `q_next` or to its negative."""
    options = []
    for target in (q_next, -q_next):
        off = [np.abs(mean - q) for mean, q in zip(means, target, strict=True)]
        options.append((sum(float(o.min()) ** 2 for o in off), [int(o.argmin()) for o in off]))
    return min(options, key=lambda option: option[0])[1]


def _along(means: Sequence[FloatArray], place: FloatArray, direction: FloatArray) -> list[int]:
    """The combination that lies from `place` most nearly in a direction."""
    step = np.stack(np.meshgrid(*means, indexing="ij"), axis=-1) - place
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    heading = np.divide(step, length, out=np.zeros_like(step), where=length > 0)
    off = np.linalg.norm(direction - heading, axis=-1)
    return [int(k) for k in np.unravel_index(int(np.argmin(off)), off.shape)]
