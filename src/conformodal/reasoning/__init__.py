"""Choosing among candidate poses with the help of relative motion. NumPy and SciPy only.

A reasoner is a function from :class:`Observations` and a :class:`MotionPrior` to a :class:`PosePath`: :func:`viterbi`,
:func:`online`. :func:`smooth` makes any path finer. :class:`Greedy` is the paper's reasoning.
"""

from .bridging import blend, bridge, predict_candidates
from .candidates import BinRuns, Candidates, interval_candidates, interval_runs, mode_candidates, softmax_mean
from .errors import ReasoningError
from .greedy import Greedy, greedy
from .observations import Observations, PosePath
from .online import LAG, OnlineReasoner, online
from .orientations import smooth_orientations
from .prior import MotionPrior, fit_motion_prior
from .smoother import smooth, smooth_positions
from .viterbi import orientation_cost, position_cost, transition_cost, viterbi

__all__ = [
    "LAG",
    "BinRuns",
    "Candidates",
    "Greedy",
    "MotionPrior",
    "Observations",
    "OnlineReasoner",
    "PosePath",
    "ReasoningError",
    "blend",
    "bridge",
    "fit_motion_prior",
    "greedy",
    "interval_candidates",
    "interval_runs",
    "mode_candidates",
    "online",
    "orientation_cost",
    "position_cost",
    "predict_candidates",
    "smooth",
    "smooth_orientations",
    "smooth_positions",
    "softmax_mean",
    "transition_cost",
    "viterbi",
]
