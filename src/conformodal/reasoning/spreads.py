"""How large the errors of candidates are, and how long they last, learnt from frames with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from conformodal.poses import Trajectory, angle_between_quats

from .candidates import Candidates, SpreadScale

FloatArray = npt.NDArray[np.float64]

# Medians of |N(0, 1)| and of the length of a standard normal vector in three dimensions.
_MEDIAN_OF_ABS_NORMAL, _MEDIAN_OF_NORM3 = 0.6745, 1.5382
_SHORTEST_MEMORY_S, _LONGEST_MEMORY_S = 1e-3, 10.0
# every frame is compared with so many after it
_LAGS = 5


def fit_spread_scale(
    candidates: Sequence[Candidates], truth: Trajectory, recording: npt.NDArray[np.int64]
) -> SpreadScale:
    """Sizes of errors in units of spreads, and their memory, from frames that no network was trained on.

    Takes the candidate nearest to the truth, and medians, so that wrong modes do not count as wide ones.

    Parameters
    ----------
    candidates
        Of n frames, not scaled.
    truth
        Their poses, in order of time within each recording.
    recording
        (n,) number of the recording that each frame is from.
    """
    z_position, z_orientation = [], []
    for c, p, q in zip(candidates, truth.positions_xyz, truth.orientations_quat_wxyz, strict=True):
        k = int(np.argmin(np.linalg.norm(c.positions_xyz - p, axis=1)))
        z_position.append((c.positions_xyz[k] - p) / c.position_spreads[k])
        angle = angle_between_quats(c.orientations_quat_wxyz, q)
        k = int(np.argmin(angle))
        z_orientation.append(angle[k] / c.orientation_spreads_rad[k])
    errors = np.array(z_position)
    x, y, z = np.maximum(np.median(np.abs(errors), axis=0) / _MEDIAN_OF_ABS_NORMAL, 0.05)
    turn = max(float(np.median(z_orientation)) / _MEDIAN_OF_NORM3, 0.05)
    memory = error_memory(errors / (x, y, z), truth.timestamps_s, recording)
    return SpreadScale((float(x), float(y), float(z)), turn, memory)


def error_memory(errors: FloatArray, timestamps_s: FloatArray, recording: npt.NDArray[np.int64]) -> float:
    """Seconds over which the correlation of `errors` (n, d) falls to 1/e; 0 if neighbours are not alike.

    Errors are taken for an Ornstein-Uhlenbeck process, of which only signs are looked at, so that neither their sizes
    nor a wrong mode now and then matter: signs of normal variables correlated by r agree by ``2 / pi asin(r)``.
    """
    agree, dt = [], []
    for lag in range(1, _LAGS + 1):
        pairs = np.flatnonzero((recording[lag:] == recording[:-lag]) & (timestamps_s[lag:] > timestamps_s[:-lag]))
        agree.append(np.sign(errors[pairs] * errors[pairs + lag]).mean(axis=1))
        dt.append(timestamps_s[pairs + lag] - timestamps_s[pairs])
    agreement, step = np.concatenate(agree), np.concatenate(dt)
    if step.size == 0:
        return 0.0

    def misfit(log_memory: float) -> float:
        return float(np.sum((agreement - 2 / np.pi * np.arcsin(np.exp(-step / np.exp(log_memory)))) ** 2))

    bounds = (np.log(_SHORTEST_MEMORY_S), np.log(_LONGEST_MEMORY_S))
    found = minimize_scalar(misfit, bounds=bounds, method="bounded")
    return float(np.exp(found.x)) if found.fun < misfit(bounds[0]) else 0.0
