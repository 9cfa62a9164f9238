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
from .prior import MotionPrior
from .viterbi import orientation_cost, position_cost

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass
class _Frame:
    candidates: Candidates
    motion: RelativeMotion | None
    timestamp_s: float
    turn_score: FloatArray
    turn_back: IntArray
    move_score: FloatArray
    move_back: IntArray
    turn_used: int  # the orientation that this frame's directions were turned by, when the next was scored


@dataclass(frozen=True)
class Revision:
    """The best path through the last frames, oldest first.

    Attributes
    ----------
    timestamps_s : (l,)
    positions_xyz : (l, 3) metres, world
    orientations_quat_wxyz : (l, 4) world from camera
    """

    timestamps_s: FloatArray
    positions_xyz: FloatArray
    orientations_quat_wxyz: FloatArray


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

    def __init__(self, prior: MotionPrior, lag: int = 30) -> None:
        if lag < 0:
            raise ReasoningError(f"lag must be at least 0 frames, got {lag}")
        self.prior = prior
        self.lag = lag
        # the frame before the newest is always needed
        self._frames: deque[_Frame] = deque(maxlen=max(lag, 1) + 1)

    def reset(self) -> None:
        """Start a new recording."""
        self._frames.clear()

    def push(self, candidates: Candidates, motion: RelativeMotion | None, timestamp_s: float) -> Revision:
        """Take the next frame; `motion` leads from the frame before, None where nothing is known of it.

        Raises
        ------
        ReasoningError
            If the timestamp is not later than the one before.
        """
        n_turns, n_moves = len(candidates.orientation_log_mass), len(candidates.position_log_mass)
        new = _Frame(
            candidates,
            motion,
            timestamp_s,
            candidates.orientation_log_mass.astype(np.float64),
            np.zeros(n_turns, dtype=np.int64),
            candidates.position_log_mass.astype(np.float64),
            np.zeros(n_moves, dtype=np.int64),
            0,
        )
        if self._frames:
            before = self._frames[-1]
            if not timestamp_s > before.timestamp_s:
                raise ReasoningError(f"timestamps must increase: {timestamp_s} s follows {before.timestamp_s} s")
            cost = orientation_cost(before.candidates, candidates, motion, timestamp_s - before.timestamp_s, self.prior)
            _advance(new, before.turn_score - cost.T, turn=True)
        self._frames.append(new)
        turns = self._way_back("turn_score", "turn_back")
        self._score_moves(turns)
        moves = self._way_back("move_score", "move_back")
        chosen = list(zip(self._frames, turns.tolist(), moves.tolist(), strict=True))[-(self.lag + 1) :]
        return Revision(
            np.array([f.timestamp_s for f, _, _ in chosen]),
            np.array([f.candidates.positions_xyz[m] for f, _, m in chosen]),
            np.array([f.candidates.orientations_quat_wxyz[t] for f, t, _ in chosen]),
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
            cost = position_cost(before.candidates, here.candidates, q_prev, here.motion, step, self.prior)
            _advance(here, before.move_score - cost.T, turn=False)

    def _way_back(self, score: str, back: str) -> IntArray:
        frames = list(self._frames)
        chosen = np.empty(len(frames), dtype=np.int64)
        at = int(np.argmax(getattr(frames[-1], score)))
        for i in range(len(frames) - 1, -1, -1):
            chosen[i] = at
            at = int(getattr(frames[i], back)[at])
        return chosen


def _advance(frame: _Frame, total: FloatArray, *, turn: bool) -> None:
    """Best predecessor of every candidate from `total` (m_here, m_before), and the score with it."""
    origin = np.argmax(total, axis=1)
    own = frame.candidates.orientation_log_mass if turn else frame.candidates.position_log_mass
    score = total[np.arange(len(origin)), origin] + own
    score = score - score.max()  # long streams must not run out of digits
    if turn:
        frame.turn_score, frame.turn_back = score, origin
    else:
        frame.move_score, frame.move_back = score, origin
