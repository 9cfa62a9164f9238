"""Promises for sequences that drift: thresholds that follow the misses they make."""

from .aci import Aci, DtAci
from .pid import ConformalPid
from .sets import OnlineConformal, Tracker

__all__ = ["Aci", "ConformalPid", "DtAci", "OnlineConformal", "Tracker"]
