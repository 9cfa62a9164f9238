"""Fixed-lag reasoning for a stream: an estimate at once, and better ones for the frames just past.

Scores of all candidates are carried on frame by frame, as in :func:`~conformodal.reasoning.viterbi`; the way back is
kept for the last frames only. What a stream costs a frame, in time and memory, does not grow with its length.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.poses import RelativeMotion

from .candidates import Candidates
from .errors import ReasoningError
from .observations import Observations, PosePath
from .prior import MotionPrior
from .settings import SEARCH
from .viterbi import backtrack, best_step, survivors, transition_cost

LAG = SEARCH.lag


@dataclass
class _Frame:
    candidates: Candidates
    timestamp_s: float
    score: FloatArray
    back: IntArray  # the best predecessor of each candidate
    start: Candidates  # where the next frame's candidates are reached from


class OnlineReasoner:
    """Global search over a stream, revised for the last `lag` frames.

    With a lag of the whole sequence the last revision is the path of :func:`~conformodal.reasoning.viterbi`.

    Parameters
    ----------
    prior
        Speeds and turning rates to expect.
    lag
        Frames before the newest whose answer may still change, at least 0.

    Raises
    ------
    ReasoningError
        If `lag` is negative.
    """

    def __init__(self, prior: MotionPrior, lag: int = LAG) -> None:
        if lag < 0:
            raise ReasoningError(f"lag must be at least 0 frames, got {lag}")
        self.prior = prior
        self.lag = lag
        self._frames: deque[_Frame] = deque(maxlen=lag + 1)

    def reset(self) -> None:
        """Start a new recording."""
        self._frames.clear()

    def push(self, candidates: Candidates, motion: RelativeMotion | None, timestamp_s: float) -> PosePath:
        """Take the next frame; `motion` leads from the frame before, None where nothing is known of it.

        Returns
        -------
        PosePath
            The best through the last frames, at most `lag` + 1 of them, oldest first, this one last.

        Raises
        ------
        ReasoningError
            If the timestamp is not later than the one before.
        """
        score, start = candidates.log_mass.astype(np.float64), candidates
        back = np.zeros(len(score), dtype=np.int64)
        if self._frames:
            before = self._frames[-1]
            step = timestamp_s - before.timestamp_s
            if not step > 0:
                raise ReasoningError(f"timestamps must increase: {timestamp_s} s follows {before.timestamp_s} s")
            cost = transition_cost(before.start, candidates, motion, step, self.prior)
            score, back = best_step(before.score, -cost, candidates.log_mass)
            start = survivors(before.start, candidates, back, cost, motion, step, self.prior)
        self._frames.append(_Frame(candidates, timestamp_s, score, back, start))
        frames = list(self._frames)
        chosen = backtrack([f.back for f in frames], int(np.argmax(score)))
        return PosePath.choose([f.candidates for f in frames], [f.timestamp_s for f in frames], chosen)


def online(seen: Observations, prior: MotionPrior, lag: int = LAG) -> PosePath:
    """The path of :class:`OnlineReasoner`: each pose as it is once `lag` frames have followed, or at the end."""
    reasoner = OnlineReasoner(prior, lag)
    parts: list[PosePath] = []
    for candidates, motion, timestamp_s in zip(seen.candidates, seen.motions, seen.timestamps_s, strict=True):
        revised = reasoner.push(candidates, motion, float(timestamp_s))
        if len(revised.timestamps_s) == lag + 1:
            parts.append(revised[:1])
    parts.append(revised[1:] if parts else revised)
    return PosePath.join(parts)
