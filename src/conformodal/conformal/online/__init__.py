"""Online conformal prediction for sequences that drift: thresholds adapt to past misses."""

from .aci import Aci
from .pid import ConformalPid
from .sets import OnlineConformal, Tracker

__all__ = ["Aci", "ConformalPid", "OnlineConformal", "Tracker"]
