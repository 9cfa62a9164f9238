"""Choosing among candidate poses with the help of relative motion. NumPy and SciPy only."""

from .candidates import (
    Candidates,
    SpreadScale,
    fit_spread_scale,
    interval_candidates,
    mode_candidates,
    softmax_mean,
)
from .errors import ReasoningError
from .greedy import greedy
from .online import OnlineReasoner, Revision
from .prior import MotionPrior, fit_motion_prior
from .smoother import smooth_orientations, smooth_positions
from .viterbi import Decoder, orientation_cost, position_cost, viterbi

__all__ = [
    "Candidates",
    "Decoder",
    "MotionPrior",
    "OnlineReasoner",
    "ReasoningError",
    "Revision",
    "SpreadScale",
    "fit_motion_prior",
    "fit_spread_scale",
    "greedy",
    "interval_candidates",
    "mode_candidates",
    "orientation_cost",
    "position_cost",
    "smooth_orientations",
    "smooth_positions",
    "softmax_mean",
    "viterbi",
]
