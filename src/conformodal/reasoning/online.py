"""Fixed-lag reasoning for a stream: an answer now, and better ones for the frames just past.

Scores of all candidates are carried on frame by frame, as in :func:`~conformodal.reasoning.viterbi`; the way back is
kept for the last frames only. What a stream costs a frame, in time and memory, does not grow with its length.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.poses import RelativeMotion

from .candidates import Candidates
from .errors import ReasoningError
from .observations import Observations, PosePath
from .prior import MotionPrior
from .viterbi import best_step, orientation_cost, position_cost, survivors, way_back

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LAG = 10


@dataclass
class _Search:
    """One frame in a search: scores of its candidates, and the best predecessor of each."""

    score: FloatArray
    back: IntArray

    @classmethod
    def start(cls, log_mass: FloatArray) -> _Search:
        return cls(log_mass.astype(np.float64), np.zeros(len(log_mass), dtype=np.int64))


@dataclass
class _Frame:
    candidates: Candidates
    motion: RelativeMotion | None
    timestamp_s: float
    turn: _Search
    move: _Search
    start: Candidates  # where the next frame's candidates are reached from
    turn_used: int = 0  # the orientation that this frame's directions were turned by, when the next was scored


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
        # the frame before the newest is always needed
        self._frames: deque[_Frame] = deque(maxlen=max(lag, 1) + 1)

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
        turn, move = _Search.start(candidates.orientation_log_mass), _Search.start(candidates.position_log_mass)
        new = _Frame(candidates, motion, timestamp_s, turn, move, start=candidates)
        if self._frames:
            before = self._frames[-1]
            if not timestamp_s > before.timestamp_s:
                raise ReasoningError(f"timestamps must increase: {timestamp_s} s follows {before.timestamp_s} s")
            cost = orientation_cost(before.candidates, candidates, motion, timestamp_s - before.timestamp_s, self.prior)
            new.turn = _Search(*best_step(before.turn.score, -cost, candidates.orientation_log_mass))
        self._frames.append(new)
        turns = _path([f.turn for f in self._frames])
        self._score_moves(turns)
        moves = _path([f.move for f in self._frames])
        last = slice(-(self.lag + 1), None)
        frames = list(self._frames)[last]
        return PosePath.choose(
            [f.candidates for f in frames], [f.timestamp_s for f in frames], moves[last], turns[last]
        )

    def _score_moves(self, turns: IntArray) -> None:
        """Score positions of the newest frame, and again from where the path of orientations has changed."""
        frames = list(self._frames)
        changed = [i for i in range(len(frames) - 1) if frames[i].turn_used != turns[i]]
        first = min([len(frames) - 1, *(i + 1 for i in changed)])
        for i in range(max(first, 1), len(frames)):
            before, here = frames[i - 1], frames[i]
            before.turn_used = int(turns[i - 1])
            q_prev = before.candidates.orientations_quat_wxyz[before.turn_used]
            step = here.timestamp_s - before.timestamp_s
            cost = position_cost(before.start, here.candidates, q_prev, here.motion, step, self.prior)
            here.move = _Search(*best_step(before.move.score, -cost, here.candidates.position_log_mass))
            here.start = survivors(before.start, here.candidates, here.move.back, cost, self.prior.reach_m(step))


def _path(search: list[_Search]) -> IntArray:
    return way_back([step.back for step in search], int(np.argmax(search[-1].score)))


def online(seen: Observations, prior: MotionPrior, lag: int = LAG) -> PosePath:
    """What :class:`OnlineReasoner` has made of every frame once `lag` more have followed it, or the recording ended."""
    reasoner = OnlineReasoner(prior, lag)
    parts: list[PosePath] = []
    for candidates, motion, timestamp_s in zip(seen.candidates, seen.motions, seen.timestamps_s, strict=True):
        revised = reasoner.push(candidates, motion, float(timestamp_s))
        if len(revised.timestamps_s) == lag + 1:
            parts.append(revised[:1])
    parts.append(revised[1:] if parts else revised)
    return PosePath.join(parts)
