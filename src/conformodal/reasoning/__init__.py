"""Choosing among candidate poses with the help of relative motion. NumPy and SciPy only.

A reasoner is a function from :class:`Observations` and a :class:`MotionPrior` to a :class:`PosePath`: :func:`viterbi`,
:func:`online`. :func:`smooth` makes any path finer. :class:`Greedy` is the paper's reasoning.
"""

from .bridging import bridge, predict_candidates
from .candidates import (
    Candidates,
    SpreadScale,
    interval_candidates,
    mode_candidates,
    softmax_mean,
)
from .errors import ReasoningError
from .fixes import add_fixes
from .greedy import Greedy, IntervalMeans, greedy, interval_means
from .observations import Observations, PosePath, Reasoner
from .online import LAG, OnlineReasoner, online
from .orientations import smooth_orientations
from .pooling import fix_cells, on_cells, pool_fixes
from .prior import MotionPrior, fit_motion_prior
from .smoother import smooth, smooth_positions
from .spreads import fit_growth, fit_spread_scale
from .viterbi import Decoder, orientation_cost, position_cost, transition_cost, viterbi

__all__ = [
    "LAG",
    "Candidates",
    "Decoder",
    "Greedy",
    "IntervalMeans",
    "MotionPrior",
    "Observations",
    "OnlineReasoner",
    "PosePath",
    "Reasoner",
    "ReasoningError",
    "SpreadScale",
    "add_fixes",
    "bridge",
    "fit_growth",
    "fit_motion_prior",
    "fit_spread_scale",
    "fix_cells",
    "greedy",
    "interval_candidates",
    "interval_means",
    "mode_candidates",
    "on_cells",
    "online",
    "orientation_cost",
    "pool_fixes",
    "position_cost",
    "predict_candidates",
    "smooth",
    "smooth_orientations",
    "smooth_positions",
    "softmax_mean",
    "transition_cost",
    "viterbi",
]
